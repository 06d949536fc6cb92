"""Stories that hypothesis makes up: runs, kills, failing disks, corruptions, verifications and
repairs, in any order. Whatever came before, the same command leads to the undisturbed data, and
`verify` calls sound only what is.
"""

import shutil
from pathlib import Path

from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from tests.chaos.commands import Command, Result, commands, prepare
from tests.chaos.disk import Disk, Mode

CHANGES = st.integers(1, 600)
"""A run of two objects changes the disk 517 times."""


def told(folder: Path, disk: Disk, *, stories: int, steps: int, seed: int = 0) -> None:
    """Try so many stories; raises AssertionError with the shortest one that does not hold."""
    work = folder / "work"
    command = commands(folder / "inputs", work, jobs=0)["generate"]
    shutil.rmtree(work, ignore_errors=True)
    prepare(work)
    disk.warm(command.begin)
    whole = command.result()
    machine = _machine(command, disk, work, whole)
    limits = settings(
        max_examples=stories,
        stateful_step_count=steps,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(_seeded(machine, seed), settings=limits)


def _seeded(machine: type[RuleBasedStateMachine], number: int) -> type[RuleBasedStateMachine]:
    return seed(number)(machine)


def _machine(
    command: Command, disk: Disk, work: Path, whole: Result
) -> type[RuleBasedStateMachine]:
    data = work / "eyeglasses"

    class Story(RuleBasedStateMachine):
        """What happens to one folder."""

        def __init__(self) -> None:
            super().__init__()
            shutil.rmtree(work, ignore_errors=True)
            prepare(work)
            self.sound = False  # whether all is there, as it was made

        @rule(at=CHANGES, mode=st.sampled_from([Mode.FAIL_ONCE, Mode.FAIL_FOR_GOOD]))
        def run_on_a_failing_disk(self, at: int, mode: Mode) -> None:
            self.goes_on(at, mode)

        @rule(at=CHANGES)
        def run_that_is_killed(self, at: int) -> None:
            self.goes_on(at, Mode.TEAR_AND_KILL)

        @rule()
        def run(self) -> None:
            self.goes_on(0, Mode.ONLY_COUNT)
            assert self.sound

        @rule(which=st.integers(0, 2), where=st.floats(0, 1, exclude_max=True))
        def flip_a_bit(self, which: int, where: float) -> None:
            """Of a shard."""
            for path in sorted(data.glob("*.h5"))[which : which + 1]:
                image = bytearray(path.read_bytes())
                image[int(where * len(image))] ^= 1
                path.write_bytes(image)
                self.sound = False

        @rule(which=st.integers(0, 2), kept=st.floats(0, 1, exclude_max=True))
        def cut_short(self, which: int, kept: float) -> None:
            for path in sorted(data.glob("*.h5"))[which : which + 1]:
                path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
                self.sound = False

        @rule(which=st.integers(0, 2))
        def lose(self, which: int) -> None:
            for path in sorted(data.glob("*.h5"))[which : which + 1]:
                path.unlink()
                self.sound = False

        @rule()
        def verify(self) -> None:
            if data.exists():
                ended = disk.run(("verify", str(data), "-j", "1"), work)
                assert (ended.status == 0) == self.sound, ended.said

        @rule()
        def repair(self) -> None:
            if data.exists():
                ended = disk.run(("verify", str(data), "-j", "1", "--repair"), work)
                assert ended.status == 0 or not self.sound, ended.said
                self.sound = ended.status == 0

        @invariant()
        def what_is_called_sound_is(self) -> None:
            assert not self.sound or command.result() == whole

        def goes_on(self, at: int, mode: Mode) -> None:
            ended = disk.run(command.begin, work, at=at, mode=mode)
            if ended.status == 0:
                self.sound = True
            elif (data / "manifest.json").exists():  # it was there already, or all but the end is
                self.sound = disk.run(("verify", str(data), "-j", "1"), work).status == 0
            else:
                self.sound = False
            assert mode != Mode.ONLY_COUNT or ended.status == 0, ended.said

        def teardown(self) -> None:
            self.run()

    return Story
