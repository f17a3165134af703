"""Pure. Why a measurement of the laser system gave no fix."""

from ccatp.errors import CcatpError, ExitStatus


class EtalonError(CcatpError):
    """Base: no fix. The message says what, where and what to do, in one line."""

    exit_status = ExitStatus.UNREACHABLE


class EtalonUnreachable(EtalonError):
    """No connection, or it was lost."""


class EtalonTimeout(EtalonError):
    """No reply within the deadline."""


class EtalonBadReply(EtalonError):
    """A reply outside the grammar, too long, or to another request."""


class EtalonServerError(EtalonError):
    """The server reports an error. ``code`` is its number, ``None`` where it refused the request in words."""

    def __init__(self, message: str, code: int | None) -> None:
        super().__init__(message)
        self.code = code


class TooFewChannels(EtalonError):
    """Fewer than four valid lengths. ``reasons`` says by channel why it was dropped."""

    def __init__(self, message: str, valid: tuple[int, ...], reasons: dict[int, str]) -> None:
        super().__init__(message)
        self.valid = valid
        self.reasons = reasons


class StaleLengths(EtalonError):
    """The server repeats the lengths of a place that the robot has left."""


class BadSolution(EtalonError):
    """The lengths give no position that can be trusted; ``__cause__`` is the error of the multilateration.

    ``lengths_m`` are the lengths by channel.
    """

    def __init__(self, message: str, lengths_m: dict[int, float]) -> None:
        super().__init__(message)
        self.lengths_m = lengths_m
