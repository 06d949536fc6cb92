"""Train a part segmenter of one's own on a category; judge it on objects that it never saw.

Run: python examples/train_your_model.py [--category oven --iterations 600]
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader

import articugen as ag

CELLS = 16


class PointNet(nn.Module):
    """Scores each point for each part: (B, N, 3) in the unit frame to (B, N, parts)."""

    def __init__(self, parts: int, width: int = 128) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(3, width), nn.ReLU(), nn.Linear(width, width))
        self.both = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, parts))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        own = self.each(points)
        whole = own.amax(dim=1, keepdim=True).expand_as(own)  # what all points say together
        return self.both(torch.cat([own, whole], dim=-1))


def trained(data: ag.DataSet, parts: int, iterations: int) -> PointNet:
    model = PointNet(parts)
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    loader = DataLoader(data.torch(points=1024), batch_size=16, shuffle=True)
    batches = (batch for _ in range(iterations) for batch in loader)
    for iteration, batch in zip(range(iterations), batches, strict=False):
        scores = model(batch["surface_points"]).flatten(0, 1)
        loss = nn.functional.cross_entropy(scores, batch["surface_part"].flatten().long())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if iteration % 100 == 0:
            print(f"iteration {iteration}: loss {loss.item():.3f}")
    return model


def place(points: np.ndarray) -> tuple[np.ndarray, ...]:
    """The cell of the unit frame that each point lies in: three whole numbers, each (n, N)."""
    return tuple(np.moveaxis(((points + 0.5) * CELLS).astype(int), -1, 0).clip(0, CELLS - 1))


def report(name: str, said: np.ndarray, truth: np.ndarray, parts: int) -> None:
    """Accuracy, and the mean IoU of the parts; both of parts (n, N)."""
    each = [(said == k, truth == k) for k in range(parts)]
    iou = np.mean([(s & t).sum() / max((s | t).sum(), 1) for s, t in each])
    print(f"{name}: accuracy {(said == truth).mean():.3f}, part IoU {iou:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--category", default="laptop")
    parser.add_argument("--data", type=Path, default="data")
    parser.add_argument("--recipe", default="quick", help="for data that are not there yet")
    parser.add_argument("--iterations", type=int, default=400)
    asked = parser.parse_args()
    if not (asked.data / asked.category / "manifest.json").exists():
        ag.generate(asked.category, out=asked.data, recipe=asked.recipe)
    data = ag.open(asked.data / asked.category)
    train, test = data.split("train"), data.split("test")
    known = train.batch(range(len(train)))  # surface_points (n, S, 3), surface_part (n, S)
    unseen = test.batch(range(len(test)), points=2048, rng=0)
    parts = 1 + int(known["surface_part"].max())

    torch.manual_seed(0)
    model = trained(train, parts, asked.iterations)
    with torch.no_grad():
        learned = model(torch.from_numpy(unseen["surface_points"])).argmax(-1).numpy()
    # The baseline knows which part is commonest at each place, and nothing of the pose.
    votes = np.zeros((CELLS, CELLS, CELLS, parts))
    np.add.at(votes, (*place(known["surface_points"]), known["surface_part"]), 1)
    guessed = votes[place(unseen["surface_points"])].argmax(-1)
    report("baseline", guessed, unseen["surface_part"], parts)
    report("PointNet", learned, unseen["surface_part"], parts)


if __name__ == "__main__":
    main()
