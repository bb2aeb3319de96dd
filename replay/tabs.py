"""The tabs of a recording's layout, as the command line names them."""

from __future__ import annotations

from typing import Literal

Tab = Literal["session", "cycles", "mean-cycle"]
