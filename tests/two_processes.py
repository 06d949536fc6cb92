"""What torchrun starts in test_ppd_processes.py: a run stopped and resumed, and one step's slopes.

torchrun --nproc-per-node=2 two_processes.py <data> <folder> <recipe.yaml> ...
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

from articugen.learning import processes
from articugen.learning.dataset import Batch, load_split
from articugen.learning.loop import train
from articugen.learning.ppd.learner import Learner
from articugen.learning.ppd.settings import TrainRecipe, load_train_recipe


def slopes(recipe: TrainRecipe, data: Path) -> dict[str, Tensor]:
    """The gradients of one step of a new model, as Adam gets them, in double precision."""
    where = torch.device("cpu")
    learner = Learner(recipe, 3, where)
    learner.model.double()
    learner.critic.double()
    split = load_split(data, "train", recipe.data, [8])
    rng = torch.Generator().manual_seed(5)
    batch = split.batch([0, 4, 2, 7], recipe.data, 8, rng).share()
    batch = Batch(batch.cloud.double(), batch.points.double(), batch.occupied, batch.spread)
    learner.learn(batch, rng, iteration=0, rate=1e-3, residual_direction=True)
    named = learner.model.named_parameters()
    return {name: p.grad for name, p in named if p.grad is not None}


if __name__ == "__main__":
    torch.set_num_threads(1)
    data, folder, *recipes = map(Path, sys.argv[1:])
    with processes.joined("cpu") as device:
        for path in recipes:
            recipe = load_train_recipe(path)
            told = {"category": "box", "data": data, "runs": folder / path.stem, "device": device}
            run = train(recipe, **told, stop_after=2)
            train(recipe, **told, resume=run.path)
            found = slopes(recipe, data)
            if processes.is_first():
                torch.save(found, run.path / "slopes.pt")
