"""Errors as messages to a user: clear ones name an argument and come from the library itself."""

import re
import traceback
from pathlib import Path

import reachjax as rj

PACKAGE = str(Path(rj.__file__).parent)

ARGUMENTS = (
    r"X0|loop|plant|controller|input_box|template|relaxation|window|solver|horizon|start|samples|"
    r"seed|progress|gap|time_limit|tube|goal|safe|avoid|Box|Polytope|Ellipsoid|Intersection|Template|"
    r"EllipsoidTemplate|MixedTemplate|AffinePlant|MLP|ClosedLoop"
)
NAMES = re.compile(rf"\b({ARGUMENTS})\b")
NUMBER = re.compile(r"[-+]?(\d+\.?\d*(e[-+]?\d+)?|\binf\b|\bnan\b)", re.IGNORECASE)


def unclear(error: BaseException) -> str | None:
    """What is wrong with an error as a message to a user; None if it is a clear one.

    A clear one is raised by a statement of the library, is of a plain kind, names an argument and
    repeats nothing that another library said. Those of solvers are none: they have to be caught.

    Example:
        >>> unclear(IndexError("tuple index out of range"))
        'IndexError from elsewhere'
    """
    inside, line = _origin(error)
    raised = inside and line.startswith("raise ")
    if isinstance(error, rj.UnsoundError):
        return "what is certified is broken"
    if type(error) not in (ValueError, TypeError, RuntimeError, NotImplementedError) or not raised:
        return f"{type(error).__name__} from {'within' if inside else 'elsewhere'}"
    if not NAMES.search(str(error)):
        return "no argument named"
    heard = error.__context__
    while heard is not None:
        if str(heard) and str(heard) in str(error) and not _origin(heard)[0]:
            return f"words of a {type(heard).__name__} from elsewhere"
        heard = heard.__context__
    return None


def _origin(error: BaseException) -> tuple[bool, str]:
    """Whether an error is of the package's own code, and the line that it comes from."""
    last = traceback.extract_tb(error.__traceback__)[-1:]
    return bool(last) and last[0].filename.startswith(PACKAGE), str(last[0].line if last else "")


def message_kind(error: BaseException) -> str:
    """The message with its numbers left out, on one line.

    Example:
        >>> message_kind(ValueError("horizon must be at least 1, but -3 arrived"))
        'ValueError: horizon must be at least #, but # arrived'
    """
    text = NUMBER.sub("#", " ".join(str(error).split()))
    text = re.sub(r"\[[\[\]#, ]*\]", "[#]", text)
    return f"{type(error).__name__}: {text[:140]}"


def place(error: BaseException) -> str:
    """Where in the package an error comes from."""
    frames = traceback.extract_tb(error.__traceback__)
    within = [frame for frame in frames if frame.filename.startswith(PACKAGE)]
    if not within:
        return "outside of the package"
    return f"reachjax/{Path(within[-1].filename).relative_to(PACKAGE)}, {within[-1].name}"
