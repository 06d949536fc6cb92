"""What an evaluation looks like: a Markdown table beside the paper's numbers.

The paper's were measured on its own data, so they are a yardstick, not a target to equal.
"""

from typing import Any

PAPER: dict[str, dict[str, float]] = {
    "label IoU, %": {
        "drawer": 74.73, "eyeglasses": 66.18, "oven": 82.07, "laptop": 86.81,
        "washing_machine": 95.15,
    },
    "EPE x 100": {
        "drawer": 3.452, "eyeglasses": 2.631, "oven": 3.360, "laptop": 2.546,
        "washing_machine": 2.529,
    },
    "F-score": {
        "drawer": 60.12, "eyeglasses": 33.61, "oven": 28.36, "laptop": 39.27,
        "washing_machine": 25.06,
    },
    "Chamfer-L1 x 100": {
        "drawer": 1.998, "eyeglasses": 2.375, "oven": 3.135, "laptop": 1.481,
        "washing_machine": 2.930,
    },
    "part type accuracy, %": {
        "drawer": 89.50, "eyeglasses": 83.25, "oven": 100.0, "laptop": 92.14,
        "washing_machine": 100.0,
    },
    "assigned parts": dict.fromkeys(
        ("drawer", "eyeglasses", "oven", "laptop", "washing_machine"), 1.0
    ),
}  # fmt: skip
"""Tables 2, 3, 4 and 6, "Ours", complete clouds, labels by canonical poses."""

PAPER_INPUTS = {"complete": (31.42, 80.99, 2.903), "depth input": (28.99, 80.65, 3.203)}
"""Its table of the two inputs: F-score, label IoU, EPE x 100."""

_ROWS = (
    ("label IoU, %", "label_iou", 100.0, "label IoU, %"),
    ("EPE x 100, joint-aware, all voted parts", "epe_joint_all", 100.0, "EPE x 100"),
    ("EPE x 100, joint-aware, dominant part", "epe_joint_dominant", 100.0, "EPE x 100"),
    ("EPE x 100, transform only, all voted parts", "epe_transform_all", 100.0, "EPE x 100"),
    ("EPE x 100, transform only, dominant part", "epe_transform_dominant", 100.0, "EPE x 100"),
    ("EPE x 100 if nothing moved", "epe_nothing_moves", 100.0, ""),
    ("F-score", "f_score", 1.0, "F-score"),
    ("Chamfer-L1 x 100", "chamfer_l1", 100.0, "Chamfer-L1 x 100"),
    ("assigned parts", "assigned_parts", 1.0, "assigned parts"),
    ("part type accuracy, %", "type_accuracy", 1.0, "part type accuracy, %"),
    ("instances without any surface, %", "no_surface", 100.0, ""),
)


def markdown(result: dict[str, Any], category: str) -> str:
    """The table of an `evaluate` result."""
    means = result["means"]
    lines = [
        f"{category}: {result['objects']} test objects, {result['instances']} instances. The "
        "paper's column was measured on other data.",
        *_left_out(result),
        "",
        "| metric | here | paper |",
        "|---|---|---|",
    ]
    for title, name, factor, paper in _ROWS:
        if name in means:
            theirs = PAPER.get(paper, {}).get(category)
            told = "" if theirs is None else f"{theirs:g}"
            lines.append(f"| {title} | {factor * means[name]:.3f} | {told} |")
    limits = {name: value for name, value in means.items() if "_below_" in name}
    if limits:
        lines += ["", "| joints right, % | error below | |", "|---|---|---|"]
        for name, value in limits.items():
            what, _, limit = name.partition("_below_")
            kind, _, quantity = what.partition("_")
            angle = quantity == "direction" or (kind, quantity) == ("revolute", "state")
            unit = "degrees" if angle else "of the unit frame"
            lines.append(f"| {kind} {quantity} | {limit} {unit} | {value:.1f} |")
    return "\n".join(lines + _depth_input(result)) + "\n"


def _depth_input(result: dict[str, Any]) -> list[str]:
    """Complete clouds beside what one depth camera sees, where both were measured."""
    if "depth_input" not in result:
        return []
    rows = [("complete", result["means"]), ("depth input", result["depth_input"]["means"])]
    lines = ["", "| input | F-score | label IoU, % | EPE x 100, joint-aware, all voted parts |"]
    lines += ["|---|---|---|---|"]
    for title, means in rows:
        told = [
            f"{factor * means[name]:.3f}" if name in means else ""
            for name, factor in (("f_score", 1.0), ("label_iou", 100.0), ("epe_joint_all", 100.0))
        ]
        lines.append(f"| {title} | {' | '.join(told)} |")
    for title, theirs in PAPER_INPUTS.items():
        told = [f"{number:.4g}" for number in theirs]
        lines.append(f"| paper, {title}, mean of its categories | {' | '.join(told)} |")
    return lines


def _left_out(result: dict[str, Any]) -> list[str]:
    """What the release's protocol does not count."""
    if "left_out" not in result:
        return []
    left = result["left_out"]
    return [
        f"Measured as the authors' release does; left out for want of a surface: label IoU of "
        f"{left['instances_label_iou']} instances, EPE of {left['instances_epe']} instances and "
        f"{left['parts_epe']} true parts."
    ]
