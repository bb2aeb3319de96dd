"""The colour map: even steps, rising lightness, legible on white and on black."""

import numpy as np
import pytest

from undulog.capture.common.palette import joint_colors, joint_hex


def luminance(colors):
    """Relative luminance of sRGB colours (IEC 61966-2-1)."""
    rgb = colors[:, :3] / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def contrast(colors, background):
    """WCAG 2.2 contrast ratio against a grey background of linear luminance 0 or 1."""
    y = luminance(colors)
    high, low = np.maximum(y, background), np.minimum(y, background)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("count", [12, 25, 60])
def test_lightness_rises_from_head_to_tail(count):
    assert (np.diff(luminance(joint_colors(count))) > 0).all()


def test_colours_read_on_black_and_on_white():
    # WCAG 2.2, success criterion 1.4.11: lines and marks.
    colors = joint_colors(60)
    assert contrast(colors, 0.0).min() >= 3
    assert contrast(colors, 1.0).min() >= 3


def test_hex_and_bytes_agree_and_one_joint_has_a_colour():
    assert joint_hex(1) == ("#{:02x}{:02x}{:02x}".format(*joint_colors(1)[0, :3]),)
    assert len(set(joint_hex(25))) == 25
