"""Imports and exports of files by the format that fits them, as the command line makes them."""

from undulog.capture.exchange.frame_export import FrameWriter
from undulog.capture.exchange.frame_import import import_frames
from undulog.capture.exchange.frame_reader import FrameReader
from undulog.capture.exchange.registry.registry import FORMATS, format_for, format_of, open_table
from undulog.capture.exchange.registry.table_folder import read_folder
from undulog.capture.exchange.table_format import TableReader, TableWriter
from undulog.capture.exchange.table_import import import_tables, of_files, prepared


def suffixes_of(kind):
    """Suffixes of the formats that a kind of writer writes."""
    return [form.suffixes[0] for form in FORMATS if isinstance(form.write, kind)]


FRAME_SUFFIXES, TABLE_SUFFIXES = suffixes_of(FrameWriter), suffixes_of(TableWriter)


def import_can(source, output, robot, *, bus=None, force=False, stop=None):
    """Import CAN frames, or, of a CSV that is damaged so, a table."""
    reader = format_of(source)[1]
    if not isinstance(reader, FrameReader):
        return import_tables(open_tables(source), output, robot=robot, force=force, stop=stop)
    with reader.open(source) as log:
        return import_frames(source, log, output, robot, bus=bus, force=force, stop=stop)


def open_tables(source, commands=None, fps=None):
    """Open a table, states and commands in two, or a folder of them."""
    if source.is_dir():
        readers = [form for form in FORMATS if isinstance(form.read, TableReader)]
        suffixes = [suffix for form in readers for suffix in form.suffixes]
        tables = read_folder(source, lambda path: path.suffix in suffixes, open_table)
    else:
        tables = of_files(open_table(source), None if commands is None else open_table(commands))
    return prepared(tables, fps)


def open_mapped(source, column_map):
    """Open a table whose columns a map names."""
    needed = [column.column for column in column_map.columns]
    return prepared(of_files(open_table(source)), needed=needed)


def export_file(source, output, *, to=None, **options):
    """Export by the suffix of the output, or by name."""
    return format_for(output, to)[2].out_of_session([source], output, **options)


def export_wide(source, output, **options):
    """Export a wide table."""
    return export_file(source, output, to="wide", **options)
