"""Angles and lengths as the report writes them."""

from collections.abc import Sequence

from articugen.core.records import JointKind
from articugen.inspection.report.facts import JointStates


def unit_of(joint: JointStates) -> str:
    """Give the sign behind a joint's states: lengths have none, not all models tell their unit."""
    return "°" if joint.kind == JointKind.REVOLUTE else ""


def range_text(low: float, high: float, unit: str) -> str:
    """Write the two ends of a range of joint states."""
    return f"{_number(low, unit)} to {_number(high, unit)}{unit}"


def _number(value: float, unit: str) -> str:
    return f"{value:.1f}" if unit else f"{value:.3g}"


def spread_text(values: Sequence[float], unit: str) -> str:
    """Write one number where all are alike, else the least and the greatest."""
    low, high = min(values), max(values)
    one, other = _number(low, unit), _number(high, unit)
    return f"{one}{unit}" if one == other else f"{one} … {other}{unit}"
