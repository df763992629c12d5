"""The errors a user can cause. Every message says what is wrong, what was expected and what was found."""

from softtissue_estimator.support.sentences import one_sentence


class SoftTissueError(Exception):
    """Anything that a caller may catch and report as one sentence.

    Whatever a file or a message holds, its text is one line that can be printed, of at most 300 characters; `args` has
    all that was said.
    """

    def __str__(self) -> str:
        return one_sentence(super().__str__())


class InvalidInputError(SoftTissueError, ValueError):
    """An argument, a parameter or an observation that cannot be used."""


class OrganNotFoundError(InvalidInputError):
    """A cloud that does not show the organ where it is expected: out of view, or with a registration that is wrong."""


class MeshError(SoftTissueError):
    """A mesh that cannot be read or has no usable geometry."""


class OrganError(SoftTissueError):
    """An organ folder that is incomplete or contradicts itself."""


class CheckpointError(SoftTissueError):
    """Network weights that are damaged or do not fit the network."""


class MissingDependencyError(SoftTissueError, ImportError):
    """Other software that something optional needs, and that is not installed."""
