"""Figures of pages as files: read by ElementTree and Pillow, held against the page."""

import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from matplotlib import colors
from PIL import Image

from support.joint_runs import write_joints
from undulog.analysis.present.matrix import Entries, matrix_picture
from undulog.analysis.present.plot_files import _mixed, figure_of, figures_of, save_plots
from undulog.analysis.present.result_files import paper_colors
from undulog.analysis.present.svg import CSS_VARIABLES, drawing, inline_svg, kept_figures
from undulog.capture.common.errors import OutputExistsError

NAMES = ("j1", "j2", "j3")
SENTINELS = [tuple(round(255 * c) for c in colors.to_rgb(colour)) for colour in CSS_VARIABLES]


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run.mcap")


def write_run(path):
    noise = np.random.default_rng(5).normal(0, 1e-3, (300, 3))
    phase = 2 * np.pi * np.arange(300)[:, None] / 50 - np.arange(3)
    angle = 0.38 * np.sin(phase - 0.2) + noise
    return write_joints(path, NAMES, 0.4 * np.sin(phase), [angle])


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def assert_no_placeholders(path):
    seen = np.unique(pixels(path).reshape(-1, 3), axis=0).tolist()
    assert not {*map(tuple, seen)} & {*SENTINELS}


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["svg", pytest.param("png", marks=pytest.mark.nightly)])
def test_each_figure_of_the_page_is_a_file(kind, run, tmp_path, command):
    folder = tmp_path / "figures"
    line = ("report", run, "-o", tmp_path / "x.html", "--plots", folder, "--format", kind)
    assert f"{folder}: segments.{kind}, signals.{kind}" in command(*line).out
    page = (tmp_path / "x.html").read_text()
    titles = re.findall(r'<svg\b[^>]*>\s*<title id="([\w-]+)-title"', page)
    figures = figures_of(page)
    assert list(figures) == [title.removesuffix("-figure") for title in titles]
    assert {path.name for path in folder.iterdir()} == {f"{name}.{kind}" for name in figures}
    for name, svg in figures.items():
        path = folder / f"{name}.{kind}"
        if kind == "svg":
            root = ET.parse(path).getroot()
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            texts = [
                "".join(element.itertext())
                for element in root.iter()
                if element.tag.endswith("text")
            ]
            page_texts = [
                "".join(element.itertext()) for element in ET.fromstring(svg).iter("text")
            ]
            assert texts == page_texts
        else:
            assert_no_placeholders(path)
            width, height = map(float, ET.fromstring(svg).get("viewBox").split()[2:])
            ratio = np.divide(*pixels(path).shape[1::-1])
            assert ratio == pytest.approx(width / height, rel=0.01)
    assert "exists already" in command(*line, code=2).err
    command(*line, "--force")


@pytest.mark.slow
def test_each_page_has_a_folder_of_its_own(run, tmp_path, command):
    write_run(tmp_path / "other.mcap")
    pages = ("-o", tmp_path / "pages", "--plots", tmp_path / "figures")
    command("report", run, tmp_path / "other.mcap", *pages)
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"run", "other"}
    assert (tmp_path / "figures" / "other" / "segments.svg").exists()
    (tmp_path / "file").write_text("")
    line = ("report", run, "-o", tmp_path / "x.html", "--plots", tmp_path / "file")
    assert "is a file; name a folder for the figures" in command(*line, code=2).err


@pytest.mark.slow
def test_colours_of_the_page_become_those_of_paper(tmp_path):
    sentinel = next(colour for colour, name in CSS_VARIABLES.items() if name == "var(--reference)")
    with kept_figures() as drawn, drawing(2.0, 2.0) as figure:
        axes = figure.subplots()
        axes.axhspan(0.0, 1.0, color=sentinel)
        svg = inline_svg(figure, "one-figure", "title", "description")
    (path,) = save_plots(svg, drawn, tmp_path / "x", "pdf")
    assert path.read_bytes().startswith(b"%PDF")
    (path,) = save_plots(svg, drawn, tmp_path / "x", "png")
    assert path.name == "one.png"
    middle = pixels(path)[200, 200] / 255
    expected = colors.to_rgb(paper_colors()["reference"])
    np.testing.assert_allclose(middle, expected, atol=1 / 255)
    with pytest.raises(OutputExistsError):
        save_plots(svg, drawn, tmp_path / "x", "png")


def entries(count):
    rng = np.random.default_rng(1)
    value = rng.normal(size=(count, count))
    value[0, 1] = np.nan
    names = tuple(f"joint{k}" for k in range(count))
    words = ("the joint that moves", "the joint that is moved", "moves with")
    return Entries("P", "meaning", names, names, value, np.full_like(value, 0.1), *words)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("count", "small"), [(4, False), pytest.param(30, False, marks=pytest.mark.nightly), (5, True)]
)
def test_a_matrix_has_the_colours_of_its_cells(count, small, tmp_path):
    shown = entries(count)
    svg = matrix_picture(shown, "coupling-figure", small=small).svg
    (path,) = save_plots(svg, {}, tmp_path / "x", "png")
    root = ET.fromstring(svg)
    width, height = map(float, root.get("viewBox").split()[2:])
    image = pixels(path)
    scale = image.shape[1] / width
    assert image.shape[0] == pytest.approx(scale * height, abs=2)
    paper = paper_colors()
    cells = [rect for rect in root.iter("rect") if rect.get("class", "").split()[0] in paper]
    assert len(cells) > count * count  # and the colour bar
    for cell in cells[: count * count - 1]:
        kind = cell.get("class").split()[0]
        share = float(cell.get("style").removeprefix("--v:").rstrip("%")) / 100
        x, y = (float(cell.get(key)) + 0.12 * float(cell.get("width")) for key in ("x", "y"))
        expected = _mixed(paper[kind], paper["paper"], share)
        np.testing.assert_allclose(image[int(scale * y), int(scale * x)] / 255, expected, atol=0.03)


@pytest.mark.slow
def test_texts_of_a_matrix_are_those_that_a_page_shows():
    drawn = {text.get_text() for text in figure_of(matrix_picture(entries(4), "m").svg).findobj(
        lambda artist: hasattr(artist, "get_text") and artist.get_text()
    )}  # fmt: skip
    assert {"joint0", "joint3", "0"} <= drawn
    assert not any(text.startswith("±") for text in drawn)  # only shown when a row has the focus


@pytest.mark.slow
def test_mixtures_are_those_of_css():
    # color-mix(in oklab, red 50%, blue), https://www.w3.org/TR/css-color-5/#color-mix
    np.testing.assert_allclose(255 * _mixed("#ff0000", "#0000ff", 0.5), (140, 83, 162), atol=0.6)
    np.testing.assert_allclose(
        _mixed("#123456", "#ffffff", 1.0), colors.to_rgb("#123456"), atol=2e-3
    )
