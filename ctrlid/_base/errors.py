"""The error with which ctrlid refuses, and the warning with which it doubts."""


class CtrlidError(ValueError):
    """A refusal: what was given, what is needed, and what to do about it.

    Every refusal of ctrlid is one of these. It is a `ValueError` too, so that scripts which guard
    python-control calls with ``except ValueError`` guard ctrlid calls as well.
    """


class ModelCannotRun(CtrlidError):
    """A model cannot be run along a record: it is lost, stops, moves too fast, or has no rest."""


class EffectDoesNotApply(CtrlidError):
    """An effect has no place in this plant, or no meaning at such values."""


class CtrlidWarning(UserWarning):
    """A result that stands, but on ground the user should look at first."""
