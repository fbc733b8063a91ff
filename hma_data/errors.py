"""Every error of ours names where, what is wrong, and what to do about it.

The command line prints one line of it and exits with `exit_code`; programs read the attributes.
"""


class HMAError(Exception):
    """Base of all.

    Attributes:
        where: the file, folder, URI or YAML path at fault.
        fault: what is wrong, with the value met.
        remedy: what to do; may be empty where the fault says it.
        exit_code: of the command line, 1 failed, 2 wrong usage.
    """

    exit_code = 1

    def __init__(self, where: object, fault: str, remedy: str = "") -> None:
        self.where, self.fault, self.remedy = str(where), fault, remedy
        super().__init__(where, fault, remedy)

    def __str__(self) -> str:
        text = f"{self.where}: {self.fault}" if self.where else self.fault
        return f"{text} — {self.remedy}" if self.remedy else text

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.where, self.fault, self.remedy)  # workers send errors to the parent


class UsageError(HMAError):
    """The command was called wrongly."""

    exit_code = 2


class RegistryError(HMAError):
    """An embodiment's YAML cannot be used as it stands."""


class SourceError(HMAError):
    """A recording cannot be read at all."""


class PluginError(HMAError):
    """A package that adds a source or a tokenizer is broken; `where` names the package."""


class StorageAwayError(SourceError):
    """Storage did not answer, however often it was asked: no fault of what is recorded there."""


class StorageError(HMAError):
    """A store refuses what is asked of it: no access, no such bucket, no room."""


class EpisodeError(HMAError):
    """One episode of a readable recording is bad: it goes to quarantine, the job goes on."""


class AlignmentError(EpisodeError):
    """An episode's streams cannot be put on one clock."""


class TokenizerError(HMAError):
    """A tokenizer or its weights cannot be used, or frames or tokens do not fit it."""


class ShardError(HMAError):
    """A shard or its manifest is damaged, or does not fit what is asked of it."""


class OutputError(HMAError):
    """An output folder holds something else than this job would write."""


class RecipeError(HMAError):
    """A recipe or an override of it is not valid."""


class TrainingError(HMAError):
    """Training cannot go on."""


class CheckpointError(HMAError):
    """A checkpoint is damaged, or does not fit what is asked of it."""


class HubError(HMAError):
    """Publishing or pulling failed."""


class MissingDependencyError(HMAError):
    """An optional package is not installed; the remedy is the command that installs it."""
