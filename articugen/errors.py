"""The errors a user can meet. Each message is one sentence that names the file and the cure."""


class ArticugenError(Exception):
    """Base of every error that the command line prints as one sentence, without a traceback."""


class InvalidSource(ArticugenError):
    """A source, a URDF or a mesh cannot be read."""


class InvalidRecipe(ArticugenError):
    """A recipe file or a command-line setting makes no sense."""


class RejectedInstance(ArticugenError):
    """One object or instance cannot be made into data; the others can."""


class NotOfCategory(ArticugenError):
    """An object has nothing to articulate in the recipe's sense: skipped, which is no fault."""


class MachineFault(ArticugenError):
    """The machine failed, not the data: no memory, a full or broken disk, a killed worker.

    Never an object's verdict: what was not made because of it is tried again by the next run.
    """


class CorruptShard(ArticugenError):
    """A shard or manifest is damaged, of another version, or not one of ours."""


class MissingExtra(ArticugenError):
    """An optional library is not installed."""

    def __init__(self, library: str, extra: str) -> None:
        super().__init__(f"{library} is not installed; run: pip install 'articugen[{extra}]'")


class MissingDriver(ArticugenError):
    """An optional library is installed, but a system library or driver that it needs is not."""


class InvalidCheckpoint(ArticugenError):
    """A checkpoint or run folder is damaged, not one of ours, or of another recipe."""


class TrainingDiverged(ArticugenError):
    """A loss or a gradient is no longer a finite number."""
