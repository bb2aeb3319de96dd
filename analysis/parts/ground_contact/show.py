"""Contact with the ground in words."""

from __future__ import annotations

from collections.abc import Iterator

from ...common.formats import in_percent
from .result import GroundContact

_LIFTED = 0.9
"""Where links are on the ground for more of a cycle, on the mean, nothing is lifted."""


def contact_lines(contact: GroundContact | None) -> Iterator[str]:
    """Yield a sentence on which links are on the ground, where they are lifted."""
    if contact is None:
        return
    links = sorted(contact.links, key=lambda link: link.share.value or 0.0)
    mean = sum(link.share.value or 0.0 for link in links) / len(links)
    if mean > _LIFTED:
        return
    least, most = (f"{in_percent(link.share)} ({link.link})" for link in (links[0], links[-1]))
    right = " to ".join(f"{100 * accuracy:.0f}" for accuracy in contact.twin_accuracy)
    yield (
        f"Ground contact, from the joints' {contact.source}: links are on the ground {least} to "
        f"{most} of a cycle, {100 * mean:.0f} % on the mean. In the twin contact and lift are "
        f"recognised in {right} %, by the gait (chance: 50 %)."
    )
