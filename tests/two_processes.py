"""What torchrun starts in test_ppd_processes.py: a run stopped and resumed, and one step's slopes.

torchrun --nproc-per-node=2 two_processes.py <data> <folder> <recipe.yaml> ...
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from articugen.learning import processes
from articugen.learning.data.split import load_split
from articugen.learning.loop import train
from articugen.learning.method import load_recipe
from articugen.learning.ppd.learner import PPDLearner
from articugen.learning.ppd.settings import PPDRecipe


def slopes(recipe: PPDRecipe, data: Path) -> dict[str, Tensor]:
    """The gradients of one step of a new model, as Adam gets them, in double precision."""
    where = torch.device("cpu")
    plan = recipe.schedule.model_copy(update={"stages": recipe.schedule.stages[1:]})
    learner = PPDLearner(recipe.model_copy(update={"schedule": plan}), 3, where)
    learner.model.double()
    learner.discriminator.double()
    split = load_split(data, "train", learner.inputs, [8])
    rng = torch.Generator().manual_seed(5)
    batch = split.batch([0, 4, 2, 7], learner.inputs, 8, rng).share()
    batch = replace(batch, cloud=batch.cloud.double(), points=batch.points.double())
    learner.learn(batch, rng, iteration=0)
    named = learner.model.named_parameters()
    return {name: p.grad for name, p in named if p.grad is not None}


if __name__ == "__main__":
    torch.set_num_threads(1)
    data, folder, *recipes = map(Path, sys.argv[1:])
    with processes.joined("cpu") as device:
        for path in recipes:
            recipe = load_recipe(path)
            told = {"category": "box", "data": data, "runs": folder / path.stem, "device": device}
            run = train(recipe, **told, stop_after=2)
            train(recipe, **told, resume=run.path)
            found = slopes(recipe, data)
            if processes.is_first():
                torch.save(found, run.path / "slopes.pt")
