"""Every view as it has been looked at: golden pictures, and proof that they catch what is wrong."""

import io

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image
from rerun.chunk import Chunk, RrdReader
from scipy.spatial.transform import Rotation

from support import golden_pictures
from undulog.replay.viewer import HeadlessViewer

pytestmark = pytest.mark.nightly

LIMIT = golden_pictures.DIFFERING
PICTURES = sorted(path.stem for path in golden_pictures.FOLDER.glob("*.png"))
BODY = "/world/snake/measured"
ANGLES = "/joints/measured"


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """The recording of the session that ships, and its views by the names of their pictures."""
    path = tmp_path_factory.mktemp("golden") / "session.rrd"
    views = golden_pictures.convert(path)
    assert len({golden_pictures.slug(name) for name in views}) == len(views)
    return path, {golden_pictures.slug(name): view for name, view in views.items()}


@pytest.fixture(scope="module")
def viewer(vulkan):
    with HeadlessViewer(golden_pictures.WINDOW) as viewer:
        yield viewer


@pytest.fixture
def worst(viewer, shipped, tmp_path):
    """Takes a view's picture and tells how far it is from the golden one."""
    recording, views = shipped

    def compare(name, stream=recording):
        png = golden_pictures.take(viewer, stream, views[name])
        (tmp_path / f"{name}.png").write_bytes(png)  # for who looks at a failure
        with Image.open(io.BytesIO(png)) as picture:
            pixels = np.asarray(picture.convert("RGB")).astype(int)
        golden = golden_pictures.load(golden_pictures.FOLDER / f"{name}.png")
        return golden_pictures.worst_tile(pixels, golden)

    return compare


def test_every_view_has_its_picture(shipped):
    assert sorted(shipped[1]) == PICTURES


@pytest.mark.parametrize("name", PICTURES)
def test_the_view_is_as_it_was_found_right(worst, name, tmp_path):
    assert worst(name) <= LIMIT, (
        f"{tmp_path / name}.png is not {golden_pictures.FOLDER / name}.png; if it is right, "
        "python tests/support/golden_pictures.py makes it golden"
    )


def test_no_picture_is_empty():
    for name in PICTURES:
        picture = golden_pictures.load(golden_pictures.FOLDER / f"{name}.png")
        assert golden_pictures.marked(picture) > 500, f"{name} shows nothing"


def changed(entity, component, change):
    """A recording in which ``change`` was made to each row of a component."""

    def edit(chunk):
        batch = chunk.to_record_batch()
        place = batch.schema.get_field_index(component)
        if chunk.entity_path != entity or place < 0:
            return chunk
        field = batch.schema.field(place)
        rows = [None if row is None else change(row) for row in batch.column(place).to_pylist()]
        (edited,) = Chunk.from_record_batch(
            batch.set_column(place, field, pa.array(rows, field.type))
        )
        return edited

    return lambda stream: stream.map(edit)


def without(entity):
    """A recording that lacks an entity."""
    return lambda stream: stream.drop(content=f"{entity}/**")


def with_item(index, value):
    """A row in which one item is another."""
    return lambda row: [*row[:index], value(row) if callable(value) else value, *row[index + 1 :]]


def bent(link, degrees):
    """A body that bends by some degrees more to the left at a link."""
    turn = Rotation.from_euler("z", degrees, degrees=True)

    def moved(row):
        points = np.array(row)
        points[link:] = points[link] + turn.apply(points[link:] - points[link])
        return points.tolist()

    def turned(row):
        return [*row[:link], *(turn * Rotation.from_quat(np.array(row))[link:]).as_quat().tolist()]

    move = changed(BODY, "Capsules3D:translations", moved)
    rotate = changed(BODY, "Capsules3D:quaternions", turned)
    return lambda stream: rotate(move(stream))


def blue_for_red(row):
    """Colours with their first and third channel exchanged; RGBA in 32 bits."""
    return [(c & 0x00FF00FF) | ((c >> 16) & 0x0000FF00) | ((c << 16) & 0xFF000000) for c in row]


def with_joint(component, index, value, entity=ANGLES):
    """A recording in which one joint's item of each row is another."""
    return changed(entity, component, with_item(index, value))


NAN = float("nan")
PLACES = "/joints/places/measured"
FIVE_MORE = with_joint("Angle:degrees", 12, lambda row: row[12] + 5.0)
OTHER_COLOR = with_joint("SeriesLines:colors", 12, lambda row: row[0])
WRONG = {
    "a joint's line has another joint's colour": ("horizontal", OTHER_COLOR),
    "a joint's line is missing": ("horizontal", with_joint("Angle:degrees", 12, NAN)),
    "a joint reads five degrees too much": ("horizontal", FIVE_MORE),
    "the middle's line is missing": (
        "head-middle-tail",
        with_joint("Scalars:scalars", 1, NAN, PLACES),
    ),
    "the ghost is missing": ("body", without("/world/snake/commanded")),
    "the trail is missing": ("body", without("/world/trail")),
    "the infrared rays are missing": ("body", without("/world/snake/ranges")),
    "the body is missing": ("body", without(BODY)),
    "a link is lost": (
        "body",
        with_joint("Capsules3D:translations", 13, [0.0, 0.0, -9.0], BODY),
    ),
    "a joint of the body is bent by five degrees too much": ("body", bent(12, 5.0)),
    "power has the wrong colours": ("body", changed(BODY, "Capsules3D:colors", blue_for_red)),
    "a bar is missing": ("lag", without("/segments/lag_degrees/estimate/joint13")),
    "electrical power is missing": ("power", without("/power/total/electrical")),
}


@pytest.mark.parametrize("fault", WRONG)
def test_what_is_wrong_is_seen(worst, shipped, fault):
    name, spoil = WRONG[fault]
    assert worst(name, spoil(RrdReader(shipped[0]).stream())) > 1.5 * LIMIT
