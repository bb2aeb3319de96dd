"""What a recording holds: decides which views there are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from undulog.analysis.results.analysis import Analysis
    from undulog.analysis.session.cycle_maps import CycleMaps
    from undulog.capture.common.arrays import FloatArray
    from undulog.capture.robot.model import Plane, Robot

COMMANDED = "/joints/commanded"
MEASURED = "/joints/measured"
ERROR = "/joints/error"
SCALARS = "Scalars:scalars"

Color = tuple[int, int, int, int]

GREY: Color = (140, 140, 140, 255)
"""Grey of everything commanded, a null or a reference."""

NAMED = (255, 95, 190, 255)
"""Pink of a module that a test names: on none of the maps."""

MAPS = "/maps"

MECHANICAL = "/power/mechanical"
TOTAL = "/power/total"

_SHORT = {
    "/joint_current": "Current",
    "/joint_voltage": "Voltage",
    "/joint_temperature": "Temperature",
    "/joint_velocity": "Velocity",
    "/energy_ledger": "Ledger",
    "/joint_power/mechanical": "Mechanical power",
    "/joint_power/mechanical_plus": "Mechanical power, positive part",
    "/joint_power/electrical": "Electrical power",
    "/joint_power/electrical_plus": "Electrical power, positive part",
}
_UNITS = {"degC": "°C"}


Tab = Literal["session", "cycles", "mean-cycle"]
"""The tabs of the layout."""


@dataclass(frozen=True)
class PlottedSeries:
    """An entity with one plotted line a joint.

    Attributes:
        component: The component that is plotted.
    """

    entity: str
    names: tuple[str, ...]
    component: str = SCALARS


@dataclass(frozen=True)
class BodyPlaces:
    """The joints that stand for head, middle and tail.

    Attributes:
        names: One to three joint names, head to tail.
        plane: The plane they bend, or None without a robot.
    """

    names: tuple[str, ...]
    plane: Plane | None

    @property
    def labels(self) -> tuple[str, ...]:
        """``head``, ``middle`` and ``tail``, or the joints' names where there are fewer."""
        return ("head", "middle", "tail") if len(self.names) == 3 else self.names

    @property
    def labelled(self) -> dict[str, str]:
        """Label by joint name."""
        return dict(zip(self.names, self.labels, strict=True))


def line_title(name: str, label: str) -> str:
    """Name of a joint's line: its name, and its label where that is another word."""
    return name if label == name else f"{name} {label}"


@dataclass(frozen=True)
class CycleQuantity:
    """Quantity of a table of cycles.

    Attributes:
        key: Last part of its entity's path, with the unit.
        unit: The unit in which it is shown.
    """

    key: str
    name: str
    unit: str


GAIN = CycleQuantity("gain_minus_one_percent", "Gain − 1", "%")
LAG = CycleQuantity("lag_degrees", "Lag", "°")
ENERGY = CycleQuantity("energy_net_joule", "Net energy", "J/cycle")


@dataclass(frozen=True)
class CycleTable:
    """One quantity of m joints that share their c cycles.

    Attributes:
        names: The joints, head to tail.
        start_s: Start of each cycle, from the session's start [s], shape (c,).
        stop_s: Its end [s], shape (c,).
        value: In the quantity's unit, NaN where it isn't known, shape (m, c).
    """

    quantity: CycleQuantity
    names: tuple[str, ...]
    start_s: FloatArray
    stop_s: FloatArray
    value: FloatArray


@dataclass(frozen=True)
class HeatMap:
    """One map.

    Attributes:
        places: Number of each joint along the body, the head's joint is 1.
        low: Value at the low end of the colours.
        high: Value at the high end.
        signed: Whether zero is in the middle of the colours.
    """

    table: CycleTable
    places: tuple[int, ...]
    low: float
    high: float
    signed: bool

    @property
    def entity(self) -> str:
        """Path of its entities."""
        return f"{MAPS}/{self.table.quantity.key}"

    @property
    def title(self) -> str:
        """Name with the range of the colours and the unit."""
        quantity = self.table.quantity
        unit = quantity.unit if quantity.unit == "°" else f" {quantity.unit}"
        low, high = self.ends
        span = f"±{high}{unit}" if self.signed else f"{low} to {high}{unit}"
        return f"{quantity.name} map, {span}"

    @property
    def ends(self) -> tuple[str, str]:
        """The range of the colours in words."""
        from undulog.analysis.common.formats import decimals_for_values, number

        digits = decimals_for_values([self.low, self.high], 3)
        return number(self.low, digits), number(self.high, digits)


@dataclass(frozen=True)
class Bar:
    """One joint's bar.

    Attributes:
        joint: The joint's name.
        place: Its number along the body, the head's joint is 1.
        far: The end of its 95 % interval that is farther from the baseline, or None.
    """

    joint: str
    place: int
    value: float
    far: float | None


@dataclass(frozen=True)
class Chart:
    """One bar chart.

    Attributes:
        key: Last part of its entity's path.
        title: What it shows, with unit.
        bars: A bar for each joint whose value could be computed.
    """

    key: str
    title: str
    bars: tuple[Bar, ...]


@dataclass(frozen=True)
class MeanCycle:
    """The mean cycle that was written.

    Attributes:
        period_s: Length of a cycle [s].
        has_body: Whether the body was drawn.
        has_places: Whether the joints that stand for the body were.
        measured: Mean angles [degrees].
        error: Mean measured minus mean commanded angle [degrees].
        power: Mean mechanical power [W].
    """

    period_s: float
    has_body: bool
    has_places: bool
    measured: tuple[PlottedSeries, ...]
    error: tuple[PlottedSeries, ...]
    power: tuple[PlottedSeries, ...]


@dataclass(frozen=True)
class Named:
    """A module that a test names.

    Attributes:
        why: The finding, without a full stop.
    """

    joint: str
    why: str


@dataclass(frozen=True)
class Layer:
    """Results of a session: its analysis, and modules that tests name.

    Attributes:
        analysis: Its numbers, or None.
        steady: Cycles of its steady gait, where no phase was logged and they were computed now.
        named: Modules that tests name, each once.
        notes: Where it is from and what is missing, a sentence each.
    """

    analysis: Analysis | None
    steady: CycleMaps | None = None
    named: tuple[Named, ...] = ()
    notes: tuple[str, ...] = ()

    def with_numbers(self, computed: Layer) -> Layer:
        """Add an analysis to results without one.

        Args:
            computed: The session's analysis, or a note why there is none.
        """
        return Layer(computed.analysis, computed.steady, self.named, (*self.notes, *computed.notes))


def signal_title(topic: str, unit: str) -> str:
    """Return a title short enough for a tab.

    Returns:
        For example ``Current [A]``; another make's topics keep their names.
    """
    return f"{_SHORT.get(topic, topic.lstrip('/'))} [{_UNITS.get(unit, unit)}]"


@dataclass(frozen=True)
class PlottedSignal:
    """A quantity of all joints that is shown as logged.

    Attributes:
        title: What it is, with unit.
        of_joints: Whether its lines are the robot's joints, known by their colours; other lines
            need a legend.
    """

    title: str
    series: tuple[PlottedSeries, ...]
    of_joints: bool


@dataclass(frozen=True)
class InitialPose:
    """Return the initial pose of the robot, for the camera.

    Attributes:
        position: The head's first known position [m].
        heading: Direction of the head there, about z [rad].
    """

    position: tuple[float, float, float]
    heading: float


@dataclass(frozen=True)
class AwaitedMap:
    """A map that is still to be computed.

    Attributes:
        title: What it will show, with unit.
    """

    entity: str
    title: str


@dataclass(frozen=True)
class Content:
    """Content of a recording.

    Attributes:
        robot: The robot, or None.
        start: Where the robot starts, or None where no body is drawn.
        power_limit_w: Power at which a segment's colour is full [W]; None if coloured by place.
        places: Joints that stand for the body, or None without joints.
        has_power: Whether the body's total power was written.
        joint_power: Mechanical power of the joints.
        modes: How often a gait mode began; 0 where none was logged.
        signals: Further quantities of the joints.
        live: Whether it still grows: the views follow its end.
        cycles: Quantities that were written cycle by cycle, each with where.
        maps: Maps of segments against cycles.
        mean: The mean cycle, or None.
    """

    robot: Robot | None
    start: InitialPose | None = None
    power_limit_w: float | None = None
    places: BodyPlaces | None = None
    commanded: tuple[PlottedSeries, ...] = ()
    measured: tuple[PlottedSeries, ...] = ()
    errors: tuple[PlottedSeries, ...] = ()
    has_power: bool = False
    joint_power: tuple[PlottedSeries, ...] = ()
    charts: tuple[Chart, ...] = ()
    modes: int = 0
    has_events: bool = False
    signals: tuple[PlottedSignal, ...] = ()
    live: bool = False
    cycles: tuple[tuple[CycleQuantity, tuple[PlottedSeries, ...]], ...] = ()
    maps: tuple[HeatMap | AwaitedMap, ...] = ()
    mean: MeanCycle | None = None
