"""The tables beside the paper's: the right numbers in the right cells, and none made up."""

from itertools import pairwise

import pytest

from articugen.core.errors import InvalidCheckpoint
from articugen.evaluation import paper
from articugen.evaluation.report import markdown, tables
from articugen.evaluation.results import (
    EvaluatedRun,
    Evaluation,
    JointState,
    LeftOut,
    Measures,
    RunEvaluation,
    read_evaluation,
)
from articugen.learning.method import load_recipe, parse_recipe


def evaluation(means):
    return Evaluation(
        means=means, votes=((1.0, 0.0), (0.0, 2.0)), labels=(0, 1), dominant=(0, 1), objects=2,
        instances=8,
    )  # fmt: skip


def result(category="laptop", variant=paper.COMPLETE, **more):
    about = {"recipe": "r", "seed": 3, "iterations": 9, "resolution": 32, "finer": 64}
    about |= {name: more.pop(name) for name in [*more] if name in EvaluatedRun.model_fields}
    known = {"label_iou": 0.5, "epe_joint_all": 0.03, "f_score": 12.0, "no_surface": 0.25} | more
    run = EvaluatedRun(category=category, variant=variant, **about)
    return RunEvaluation(run=run, **dict(evaluation(known)))


def rows(text):
    """The cells of every row by its table's title and its own."""
    cells, title = {}, ""
    for before, line in pairwise(["", *text.splitlines()]):
        row = [cell.strip() for cell in line.strip("|").split(" | ")]
        title = row[0] if not before else title
        if line.startswith("| "):
            cells[title, row[0]] = row[1:]
    return cells


def test_the_paper_s_numbers_stand_beside_ours():
    known = {"finer_label_iou": 0.75, "label_iou_all_poses": 0.625}
    text = tables([result(**known)])
    labels = rows(text)
    assert labels["laptop, shapes", "laptop, shapes"] == ["T3 EPE", "T4 F-score"]
    assert labels["laptop, shapes", "r"] == ["3.000", "12.00"]  # Chamfer-L1 was not measured
    assert labels["laptop, shapes", "paper: NSD, 10 parts"] == ["-", "83.71"]
    assert labels["laptop, labels", "laptop, labels"] == [
        "T2 label IoU", "T2 finer", "T8 all", "T8 less T2",
    ]  # fmt: skip
    assert labels["laptop, labels", "floor"] == ["25.00", "25.00", "25.00", "-"]
    assert labels["laptop, labels", "paper: PPD, 8 parts"] == ["86.81", "86.81", "86.80", "-0.01"]
    assert labels["laptop, labels", "r"] == ["50.00", "75.00", "62.50", "12.50"]
    assert labels["laptop, labels", "paper: BSP-Net, 256 parts"][2:] == ["86.21", "9.53"]
    assert labels["laptop, labels", "paper: BSP-Net, 8 parts"] == ["-", "-", "82.64", "-"]
    assert "25.11*" in text
    assert "one part stands for the whole shape" in text
    known |= {"assigned_parts": 1.0, "type_accuracy": 100.0, "epe_transform_all": 0.01}
    whole = tables([result(**known, chamfer_l1=0.02)])
    assert "T9 kinds" in whole
    assert max(map(len, whole.splitlines())) <= 100


def test_seeds_become_mean_and_spread():
    """Of a seed that was evaluated twice the last counts; other settings are another row."""
    same = [result(seed=s, label_iou=v) for s, v in ((0, 0.1), (1, 0.4), (2, 0.5), (0, 0.3))]
    other = result(seed=0, label_iou=0.9, recipe_sha256="ab12" + "0" * 60)
    cells = rows(tables(same))
    assert cells["laptop, labels", "r"] == ["40.00"]
    assert cells["laptop, labels", "± of 3 seeds"] == ["10.00"]  # of 30, 40, 50
    assert cells["recipe", "r"] == ["2", "-", "9", "-", "3"]
    cells = rows(tables([*same, other]))
    assert cells["laptop, labels", "r #ab12"] == ["90.00"]
    assert cells["laptop, labels", "r #"] == ["40.00"]


def test_it_is_said_how_large_what_is_and_what_it_is_given():
    known = result(knows="groups", parameters=1234567, seconds=600.0)
    taught = result(method="npcs", knows="labels", recipe="npcs")
    text = tables([known, taught, result(method="bae", recipe="bae")])
    assert rows(text)["recipe", "r (g)"] == ["2", "1,234,567", "9", "10.0", "1"]
    assert ("recipe", "paper: NSD") not in rows(text)
    assert rows(text)["recipe", "paper: BAE-Net"] == ["8", "5,252,000", "-", "-", "-"]
    assert "(g): training is given which instances show one object." in text
    assert "(s): supervised" in text
    assert "(g)" not in tables([taught])
    text = tables([known], {"nsd": "data/x: holds no points; make them"})
    assert "Not trained: nsd: data/x: holds no points; make them" in text


def test_pose_estimators_have_a_table_of_their_own_with_dashes_for_what_is_not_known():
    known = {
        "matched_part_iou": 0.9, "matched_rotation_degrees_all": 5.5,
        "matched_direction_degrees": 4.0, "matched_motion": 0.05, "matched_pivot_distance": 0.0312,
    }  # fmt: skip
    segments = result(method="bae", recipe="bae")
    segments = segments.model_copy(update={"means": {"matched_part_iou": 0.5}})
    cells = rows(tables([result(**known), segments]))
    title = "laptop, as SCAPO and OP-Align"
    assert cells[title, title] == ["part IoU", "turn °", "axis °", "pivot", "E"]
    assert cells[title, "r"] == ["90.0", "5.50", "4.00", "3.12", "5.00"]
    assert cells[title, "bae"] == ["50.0", "-", "-", "-", "-"]
    assert "as SCAPO and OP-Align" not in tables([result("oven")])


def test_several_categories_are_columns_and_the_mean_needs_all_five():
    four = [result(c, label_iou=0.1 * i) for i, c in enumerate(paper.CATEGORIES[:4])]
    title = "table 2: label IoU, %"
    cells = rows(tables(four))
    assert cells[title, title] == [*paper.CATEGORIES[:4]]
    assert cells[title, "r"] == ["0.00", "10.00", "20.00", "30.00"]
    cells = rows(tables([*four, result("washing_machine", label_iou=0.4)]))
    assert cells[title, title][-1] == "mean"
    assert cells[title, "r"][-2:] == ["40.00", "20.00"]
    assert cells[title, "paper: PPD, 8 parts"][-1] == "80.99"


def test_the_paper_s_numbers_were_typed_rightly():
    for table in (paper.LABEL_IOU, paper.EPE, paper.F_SCORE, paper.CHAMFER_L1):
        for method, numbers in table.items():
            if (method, numbers[0]) == ("bsp8", ""):
                continue
            *each, mean = (float(n.rstrip("*")) for n in numbers)
            assert sum(each) / 5 == pytest.approx(mean, abs=0.006)
    for method, numbers in paper.LABEL_IOU_ALL_POSES.items():
        *each, mean = map(float, numbers)
        assert sum(each) / 5 == pytest.approx(mean, abs=0.006)
        change = mean - float(paper.LABEL_IOU[method][-1])
        assert float(paper.DIFFERENCE[method][-1]) == pytest.approx(change, abs=0.0101)


def test_a_run_is_counted_in_its_own_row_of_the_ablation():
    text = tables(
        [result(recipe="a"), result("oven", "w/o L_adv_g"), result(variant="w/o L_vol", recipe="v")]
    )
    lines = [line.strip("| ") for line in text.split("table 5")[1].splitlines()]
    names = [line.split(" | ")[0].strip() for line in lines]
    at = names.index("paper, mean: w/o L_adv_g")
    assert lines[at + 1].split() == ["r", "|", "50.00", "|", "3.000"]
    assert names[names.index("paper, mean: w/ all") + 1] == "a"
    assert names[names.index("paper, mean: w/o CS") + 1] == "paper, mean: w/o CP"
    assert lines[at].split()[4:] == ["|", "70.14", "|", "7.276"]
    assert "table 5" not in tables([result()])


def test_lines_through_joint_states_are_told():
    turned = ((0.0, 3.0), (1.0, 2.25), (2.0, 0.75), (3.0, 0.0), (4.0, None))
    states = [(0, "revolute", *pair) for pair in turned] + [(1, "prismatic", 0.5, None)]
    fields = ("joint", "kind", "true", "predicted")
    states = tuple(
        JointState(object="o", state_index=k, **dict(zip(fields, state, strict=True)))
        for k, state in enumerate(states)
    )
    told = markdown(result(reconstruction_iou=0.61).model_copy(update={"joint_states": states}))
    assert "| joint 0, revolute | -1.050 | 0.168 rad | 4 of 5 |" in told
    assert "| joint 1, prismatic |   |   | 0 of 1 |" in told
    assert "| reconstruction IoU on the meshes' grid, % | 61.000 |" in told


def test_the_worst_objects_stand_first_and_those_without_labels_before_them():
    found = {"a": 0.9, "b": None, "c": 0.1, "d": 0.5}
    measures = tuple(
        Measures(
            object=name,
            state_index=1,
            values={"f_score": 1.0} | ({"label_iou": iou} if iou else {}),
        )
        for name, iou in found.items()
    )
    told = markdown(result().model_copy(update={"measures": measures}))
    lines = [line.split("|")[1].strip() for line in told.splitlines() if line.startswith("| ")]
    assert [name for name in lines if name in found] == ["b", "c", "d", "a"]


def test_what_failed_is_told():
    text = markdown(result())
    assert "| instances without any surface, % | 25.000 |" in text
    assert "other data" in text
    assert "8 instances" in text


def test_depth_input_has_its_row():
    by_depth = result(method="ppd_depth", input="depth")
    by_depth = by_depth.model_copy(update={"means": {"f_score": 7.0}})
    cells, title = rows(tables([result(), by_depth])), "laptop, table 6: input"
    assert cells[title, "r, depth"] == ["7.00", "-", "-"]
    assert cells[title, "r"] == ["12.00", "50.00", "3.000"]
    assert cells[title, "paper, mean: depth"] == ["28.99", "80.65", "3.203"]
    assert "table 6" not in tables([result()])
    cells = rows(tables([by_depth]))
    assert cells["laptop, shapes", "r, depth"] == ["7.00"]
    assert "table 5" not in tables([by_depth])


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
    """A method that only segments: a dash where it measures nothing."""
    segments = result(method="bae", recipe="bae")
    segments = segments.model_copy(update={"means": {"label_iou": 0.25}})
    text = tables([result(), result(variant="w/o CS", recipe="c"), segments])
    cells = rows(text)
    assert cells["laptop, shapes", "bae"] == ["-", "-"]
    assert "| bae " not in text.split("table 5")[1]
    names = [name for _, name in cells]
    assert names.index("bae") > names.index("r")
    assert "table 5" not in tables([segments])
    assert "label IoU" in markdown(segments)
