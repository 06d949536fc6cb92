"""What test_ranks.py starts: ranks, each a process of its own, of which some are killed.

python rank_processes.py <out> <objects> <how many ranks>[:<rank>=<moment>,...] ...

A moment is what a rank is at when SIGKILL comes: "shard", with a temporary file half checked;
"record", with a shard that no record tells of; "object", with one of its objects recorded. The
others work on; the next so many ranks are started when all have ended.
"""

import os
import signal
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from articugen.pipeline import door
from articugen.pipeline.executors.local import Local
from articugen.pipeline.job import Share
from articugen.pipeline.records import Records
from articugen.pipeline.run import started
from articugen.store import writer
from tests.test_pipeline import TINY, job


def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def be(share: Share, out: Path, objects: int, moment: str) -> None:
    if moment == "shard":
        writer.sha256_of = die
    if moment == "record":
        Records.record = die
    recipe = TINY.with_options(objects=objects, states=0)
    with started(job(out, recipe=recipe, share=share)) as run:
        run.finish(Local(0), die if moment == "object" else lambda _: None)


if __name__ == "__main__":
    out, objects = Path(sys.argv[1]), int(sys.argv[2])
    with TemporaryDirectory() as folder:  # what is loaded before the fork is loaded once
        door.make(job(Path(folder), recipe=TINY.with_options(objects=1, states=0)))
    for words in sys.argv[3:]:
        of, _, killed = words.partition(":")
        moments = dict(word.split("=") for word in killed.split(",") if word)
        children = []
        for number in range(int(of)):
            child = os.fork()
            if child == 0:
                be(Share(number=number, of=int(of)), out, objects, moments.get(str(number), ""))
                os._exit(0)
            children.append(child)
        statuses = [os.waitpid(child, 0)[1] for child in children]
        sys.stdout.write(" ".join(map(str, statuses)) + "\n")
