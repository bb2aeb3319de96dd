"""Logs as the mcap library writes them."""

from contextlib import contextmanager

from mcap.writer import Writer

from undulog.capture.log.messages.definitions import schema_text


@contextmanager
def foreign_log(path, type_name="std_msgs/msg/String", definition=None, **options):
    """Write a file; yields the library's writer and the id of the schema."""
    text = schema_text(type_name) if definition is None else definition
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2", library="elsewhere")
        yield writer, writer.register_schema(type_name, "ros2msg", text.encode())
        writer.finish()
