"""The tables beside the paper's: the right numbers in the right cells, and none made up."""

import pytest

from articugen.core.errors import InvalidCheckpoint
from articugen.learning.evaluation import paper
from articugen.learning.evaluation.report import markdown, tables
from articugen.learning.evaluation.results import (
    EvaluatedRun,
    Evaluation,
    JointLine,
    LeftOut,
    RunEvaluation,
    read_evaluation,
)
from articugen.learning.method import load_recipe, parse_recipe


def evaluation(means):
    return Evaluation(
        means=means, votes=((1.0, 0.0), (0.0, 2.0)), labels=(0, 1), dominant=(0, 1), objects=2,
        instances=8,
    )  # fmt: skip


def result(category="laptop", variant=paper.COMPLETE, poses="canonical", method="ppd", **means):
    known = {"label_iou": 0.5, "epe_joint_all": 0.03, "f_score": 12.0, "no_surface": 0.25} | means
    run = EvaluatedRun(
        method=method, category=category, variant=variant, label_poses=poses, recipe="r", seed=3,
        iterations=9, resolution=32, finer=64,
    )  # fmt: skip
    return RunEvaluation(run=run, **dict(evaluation(known)))


def rows(text):
    """The cells of every row, by the row's first two."""
    split = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines()]
    return {tuple(cells[:3]): cells[3:] for cells in split if len(cells) > 3}


def test_the_paper_s_numbers_stand_beside_ours():
    told = rows(tables([result()]))
    assert told["2", "label IoU, %", "laptop"] == [
        "**50.00**",
        "86.81",
        "25.11*",
        "76.68",
        "74.44",
        "",
    ]
    assert ("2", "label IoU, %, meshes on 64^3", "laptop") not in told
    told = rows(tables([result(finer_label_iou=0.75)]))
    assert told["2", "label IoU, %, meshes on 64^3", "laptop"][:2] == ["**75.00**", "86.81"]
    assert told["2", "label IoU, %", "laptop"][0] == "**50.00**"
    assert told["3", "EPE x 100, joint-aware", "laptop"] == [
        "**3.000**",
        "2.546",
        "",
        "",
        "",
        "0.751",
    ]
    assert told["4", "F-score", "laptop"] == ["**12.00**", "39.27", "30.97", "65.90", "83.71", ""]
    assert not any(name[1] == "Chamfer-L1 x 100" for name in told)  # not measured, not shown


def test_pose_estimators_have_a_table_of_their_own_with_blanks_for_what_is_not_known():
    known = {
        "matched_part_iou": 0.9, "matched_rotation_degrees_all": 5.5,
        "matched_direction_degrees": 4.0, "matched_pivot_distance": 0.0312,
    }  # fmt: skip
    segments = result(method="bae", variant="bae")
    segments = segments.model_copy(update={"means": {"matched_part_iou": 0.5}})
    text = tables([result(**known), result("oven"), segments])
    lines = {
        line.split(" | ")[0]: [cell.strip(" *") for cell in line.strip("|").split("|")]
        for line in text.splitlines()
    }
    assert lines["| laptop, ppd"][1:3] == ["90.0", "5.50"]
    assert lines["| laptop, ppd"][6:] == ["4.00", "3.12", "", ""]
    assert lines["| laptop, bae"][1:] == ["50.0", *[""] * 8]
    assert "| oven, ppd" not in lines  # evaluated before there were such measures
    assert "as SCAPO and OP-Align measure" not in tables([result("oven")])


def test_labels_by_all_poses_have_their_own_table():
    told = rows(tables([result(poses="all")]))
    assert told["8", "label IoU, %", "laptop"][1] == "86.80"


def test_the_mean_needs_all_five_categories():
    four = [result(c, label_iou=0.1 * i) for i, c in enumerate(paper.CATEGORIES[:4])]
    assert ("2", "label IoU, %", "mean") not in rows(tables(four))
    told = rows(tables([*four, result("washing_machine", label_iou=0.4)]))
    assert told["2", "label IoU, %", "mean"][:2] == ["**20.00**", "80.99"]
    for table in (paper.LABEL_IOU, paper.EPE, paper.F_SCORE, paper.CHAMFER_L1):
        for numbers in table.values():
            *each, mean = (float(n.rstrip("*")) for n in numbers)
            assert sum(each) / 5 == pytest.approx(mean, abs=0.006)  # nothing was mistyped


def test_a_run_is_counted_in_its_own_row_of_the_ablation():
    told = tables([result(), result("oven", "w/o L_adv_g"), result("oven", "w/o L_vol, CS")])
    assert "| w/o L_adv_g (here: oven by r) | **50.00** | 70.14 | **3.000** | 7.276 |" in told
    assert "| w/ all (here: laptop by r) | **50.00** | 80.99 | **3.000** | 2.988 |" in told
    assert "| w/o L_vol, CS (here: oven by r) | **50.00** |  | **3.000** |  |" in told
    assert "| w/o CS |  | 55.67 |  | 8.827 |" in told


def test_lines_through_joint_states_are_told():
    line = JointLine(joint=0, kind="revolute", states=9, predicted=8, slope=-0.98765,
                     offset=3.0, residual=0.0123)  # fmt: skip
    lost = JointLine(joint=1, kind="prismatic", states=9, predicted=0, slope=None, offset=None,
                     residual=None)  # fmt: skip
    lines = {"joint_lines": (line, lost)}
    told = markdown(result(reconstruction_iou=0.61).model_copy(update=lines))
    assert "| joint 0, revolute | -0.988 | 0.012 rad | 8 of 9 |" in told
    assert "| joint 1, prismatic |   |   | 0 of 9 |" in told
    assert "| reconstruction IoU on the meshes' grid, % | 61.000 |" in told


def test_what_failed_is_told():
    text = markdown(result())
    assert "| instances without any surface, % | 25.000 |" in text
    assert "other data" in text
    assert "8 instances" in text


def test_depth_input_has_its_row():
    seen = result(method="ppd_depth")
    run = seen.run.model_copy(update={"input": "depth"})
    seen = seen.model_copy(update={"run": run, "means": {"f_score": 7.0}})
    depth = "| depth (here: laptop by r) | **7.00** | 28.99 |  | 80.65 |  | 3.203 |"
    both = tables([result(), seen])
    assert depth in both
    assert "| complete (here: laptop by r) | **12.00** | 31.42 |" in both
    assert both.replace(depth, "| depth | | 28.99 |  | 80.65 |  | 3.203 |") == tables(
        [result()]
    ).replace("| depth |  | 28.99", "| depth | | 28.99")
    alone = tables([seen])
    assert depth in alone
    assert rows(alone)["4", "F-score", "laptop"][0] == "**7.00**"
    assert "table 5" not in alone


def test_recipes_know_their_row():
    assert load_recipe("ppd_paper").variant == paper.COMPLETE
    assert load_recipe("ppd_plain").variant == "w/o L_adv_g"
    assert load_recipe("ppd_quick").variant == "w/o L_vol, L_loc, L_var, L_adv_g"
    changed = load_recipe("ppd_paper").plain()
    changed["losses"]["vol"] = 0.0
    changed["model"]["common_pose"] = False
    assert parse_recipe(changed, "changed").variant == "w/o L_vol, CP"


def test_a_run_without_evaluation_is_refused(tmp_path):
    with pytest.raises(InvalidCheckpoint, match="articugen evaluate"):
        read_evaluation(tmp_path)


def test_an_evaluation_is_read_as_it_was_written(tmp_path):
    (tmp_path / "evaluation").mkdir()
    more = {"left_out": LeftOut(parts_epe=3)}
    for written in (result(), result().model_copy(update=more)):
        written.write(tmp_path / "evaluation")
        assert read_evaluation(tmp_path) == written


def test_another_method_stands_beside_ppd_and_not_in_its_ablation():
    """A method that only segments: a column of its own, blank where it measures nothing."""
    segments = result(method="bae", variant="bae")
    segments = segments.model_copy(update={"means": {"label_iou": 0.25}})
    told = rows(tables([result(), segments]))
    assert told["table", "metric", "category"][:3] == ["here: ppd", "here: bae", "PPD, paper"]
    assert told["2", "label IoU, %", "laptop"][:3] == ["**50.00**", "**25.00**", "86.81"]
    assert told["3", "EPE x 100, joint-aware", "laptop"][:3] == ["**3.000**", "", "2.546"]
    assert "table 5" in tables([result(), segments])
    assert "bae by r" not in tables([result(), segments])
    assert "table 5" not in tables([segments])
    assert "label IoU" in markdown(segments)
