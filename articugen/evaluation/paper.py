"""The numbers printed in the paper, as they are printed.

They were measured on the paper's data, so they are a yardstick, not a target to equal.
"""

from typing import NamedTuple

CATEGORIES = ("drawer", "eyeglasses", "oven", "laptop", "washing_machine")
"""The columns of the tables, followed there by their mean."""

METHOD = "ppd"
"""The name here of the paper's own method, which Tables 5 and 6 are about."""


class Row(NamedTuple):
    """A method of the paper: what it is called there, and the numbers that say how large it is."""

    title: str
    parts: int | None = None
    parameters: float | None = None


METHODS = {
    "ppd": Row("PPD", 8, 2.149e5),
    "bae": Row("BAE-Net", 8, 52.52e5),
    "bsp": Row("BSP-Net", 256, 443.3e5),
    "bsp8": Row("BSP-Net", 8),
    "nsd": Row("NSD", 10, 6.657e5),
    "npcs": Row("NPCS, supervised"),
}
"""By the names of methods here. The second BSP-Net is in Table 8 alone."""

Numbers = dict[str, tuple[str, ...]]
"""By method, one for each category, and the mean."""

LABEL_IOU: Numbers = {
    "ppd": ("74.73", "66.18", "82.07", "86.81", "95.15", "80.99"),
    "bae": ("6.25*", "11.11*", "73.06", "25.11*", "80.30", "39.17"),
    "bsp": ("66.31", "70.69", "81.65", "76.68", "87.92", "76.65"),
    "bsp8": ("", "", "", "", "", "66.79"),
    "nsd": ("38.39", "42.11", "74.67", "74.44", "89.11", "63.75"),
}
"""Table 2, %: labels by canonical poses. A star: one part stands for the whole shape."""

LABEL_IOU_ALL_POSES: Numbers = {
    "ppd": ("74.83", "66.25", "82.06", "86.80", "95.18", "81.02"),
    "bae": ("6.25", "11.11", "73.01", "25.11", "80.32", "39.16"),
    "bsp": ("70.29", "74.96", "89.40", "86.21", "95.28", "83.23"),
    "bsp8": ("28.94", "71.19", "84.69", "82.64", "91.11", "71.71"),
    "nsd": ("38.56", "44.06", "74.63", "74.40", "89.01", "64.13"),
}
"""Table 8, %: labels by all poses."""

_MEAN_DIFFERENCE = {"ppd": "0.04", "bae": "-0.01", "bsp": "6.58", "bsp8": "4.92", "nsd": "0.39"}

DIFFERENCE: Numbers = {
    method: (
        *(
            f"{float(by_all) - float(canonical.strip('*')):.2f}" if canonical else ""
            for by_all, canonical in zip(row[:-1], LABEL_IOU[method], strict=False)
        ),
        _MEAN_DIFFERENCE[method],
    )
    for method, row in LABEL_IOU_ALL_POSES.items()
}
"""Table 8, by all poses less by canonical ones: the means as printed, categories from the above."""

EPE: Numbers = {
    "ppd": ("3.452", "2.631", "3.360", "2.546", "2.529", "2.903"),
    "npcs": ("1.598", "1.087", "2.702", "0.751", "1.594", "1.546"),
}
"""Table 3, x 100."""

F_SCORE: Numbers = {
    "ppd": ("60.12", "33.61", "28.36", "39.27", "25.06", "37.28"),
    "bae": ("25.74", "25.77", "20.08", "30.97", "24.68", "25.45"),
    "bsp": ("42.22", "49.08", "46.01", "65.90", "57.39", "52.12"),
    "nsd": ("53.35", "48.63", "39.58", "83.71", "44.26", "53.91"),
}
CHAMFER_L1: Numbers = {
    "ppd": ("1.998", "2.375", "3.135", "1.481", "2.930", "2.384"),
    "bae": ("2.360", "3.918", "4.314", "1.867", "3.595", "3.211"),
    "bsp": ("1.637", "1.431", "1.931", "1.015", "1.338", "1.471"),
    "nsd": ("1.594", "1.642", "2.819", "0.649", "2.128", "1.766"),
}
"""Table 4; Chamfer-L1 x 100."""

ASSIGNED_PARTS: Numbers = {"ppd": ("1.0", "1.0", "1.0", "1.0", "1.0", "1.0")}
TYPE_ACCURACY: Numbers = {"ppd": ("89.50", "83.25", "100.0", "92.14", "100.0", "91.46")}
"""Table 9; the accuracy in %."""

COMPLETE = "w/ all"

ABLATION = {
    "w/o L_vol": ("72.20", "4.362"),
    "w/o L_dev": ("73.21", "6.628"),
    "w/o L_loc": ("74.27", "9.250"),
    "w/o L_var": ("65.29", "6.676"),
    "w/o L_adv_g": ("70.14", "7.276"),
    "w/o CS": ("55.67", "8.827"),
    "w/o CP": ("71.35", "7.219"),
    COMPLETE: ("80.99", "2.988"),
}
"""Table 5: label IoU and EPE, means of the five categories."""

INPUTS = {"complete": ("31.42", "80.99", "2.903"), "depth": ("28.99", "80.65", "3.203")}
"""Table 6: F-score, label IoU and EPE, means of the five categories, as printed (Tables 4 and 5
have another F-score and another EPE)."""
