"""The colour map: even steps, rising lightness, legible on white and on black."""

import numpy as np
import pytest

from support.colour_vision import contrast, luminance
from undulog.capture.common.palette import joint_colors, joint_hex


@pytest.mark.parametrize("count", [12, 25, 60])
def test_lightness_rises_from_head_to_tail(count):
    assert (np.diff([luminance(color) for color in joint_hex(count)]) > 0).all()


def test_colours_read_on_black_and_on_white():
    # WCAG 2.2, success criterion 1.4.11: lines and marks.
    assert min(contrast(color, "#000000") for color in joint_hex(60)) >= 3
    assert min(contrast(color, "#ffffff") for color in joint_hex(60)) >= 3


@pytest.mark.parametrize("count", [1, 12, 25, 60])
def test_hex_and_bytes_agree_and_each_joint_has_a_colour(count):
    bytes_of = joint_colors(count)[:, :3]
    assert joint_hex(count) == tuple("#{:02x}{:02x}{:02x}".format(*colour) for colour in bytes_of)
    assert len(set(joint_hex(count))) == count
