"""All errors of the package `failover`: one family, one sentence per class."""

from __future__ import annotations


class FailoverError(Exception):
    """Something about protecting a component did not work; the message says what, on what, why not and what to do."""


class NoAgentError(FailoverError):
    """No agent answers on its control socket."""


class AgentRefusedError(FailoverError):
    """The agent understood a request and says no.

    Attributes:
        kind: name of the error class on the agent's side ("UnsupportedError", "UnknownComponentError" …).
        reasons: one sentence each, with what to do about it.
    """

    def __init__(self, message: str, kind: str = "", reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.kind = kind
        self.reasons = reasons


class RequestError(FailoverError):
    """What the agent is to be asked cannot be said to it."""


class LostAgentError(FailoverError):
    """The agent went away in the middle of an answer."""


class FileMistakeError(FailoverError):
    """A file that a person wrote holds a mistake; the message names file, line and cure."""


class TeamFileError(FailoverError):
    """The team directory or a key in it cannot be used."""


class InvitationError(FailoverError):
    """An invitation to a team cannot be used: it is none, it is over, or the other side refused it; nothing is left behind."""


class RulesError(FailoverError):
    """A setting contradicts another one or leaves its range; the message names the setting and the cure."""


class BoardError(FailoverError):
    """Something about the team's board does not work; the message says what, on which file or item, and what to do."""


class BoardGoneError(BoardError):
    """The board that was open was removed or made anew; a program that calls again works with the new one."""


class ScheduleError(FailoverError):
    """Something about the schedule of tasks does not work, and nothing changed; the message names the task and the cure."""


class ScheduleGoneError(ScheduleError):
    """The schedule that was open was removed or made anew; a program that calls again works with the new one."""


class NeverWrittenError(BoardError):
    """An item has no value yet: its writer has not put one."""


class OvertakenError(BoardError):
    """An item is written so fast that it cannot be read whole; it needs more banks, or fewer puts."""


class WriterTakenError(BoardError):
    """Another process writes this item; the message names its pid."""


class RecordingError(FailoverError):
    """A recording of the board cannot be made, read or replayed; the message names the file, and what was kept."""


class BridgeError(FailoverError):
    """Programs of another middleware cannot be reached, or asked for what a bridge has not; the message says what to do."""


class ArchiveError(FailoverError):
    """An archive of checkpoints cannot be reached, or holds not what was sealed; the message names the object and the cure."""


class ItemError(FailoverError):
    """An item of the board is declared in a way that cannot work; nothing was changed.

    Attributes:
        key: the key of the declaration that is wrong ("type", "period" …); "" for the declaration as a whole.
    """

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


class ImportFailedError(FailoverError):
    """A file of items was read, and the sizes of its C types cannot be learnt; nothing was written.

    Attributes:
        reasons: the compiler's own sentences.
    """

    def __init__(self, message: str, reasons: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.reasons = reasons


class ValueMisfitError(FailoverError):
    """A value does not fit the declared type of its item; the item keeps the value that it has."""


class ScreenError(FailoverError):
    """The full screen cannot be shown: there is no terminal, or its library is missing."""


class NameFormatError(FailoverError):
    """A name of a robot, a team or a component is not of the documented form."""


class RightsError(FailoverError):
    """A rule, a verb or a path of rights is not of the documented form; names the cure.

    Attributes:
        key: the key of the rule that is wrong ("groups", "verbs", "paths", "hours"); "" for the rule as a whole.
    """

    def __init__(self, message: str, key: str = "") -> None:
        super().__init__(message)
        self.key = key


class NameUnknownError(FailoverError):
    """Nothing that this process has heard of answers to a name."""


class NameAmbiguousError(FailoverError):
    """Several things answer to a name; the message lists their paths.

    Attributes:
        paths: of all of them.
    """

    def __init__(self, message: str, paths: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.paths = paths


class EnvelopeError(FailoverError):
    """Bytes that came as a message are none that can be carried out; nothing was done."""


class MailboxFullError(FailoverError):
    """As many messages as may wait are waiting; this one was not taken. Send it again later."""


class DriverError(FailoverError):
    """A driver is declared in a way that cannot work, or cannot take messages; the message says why and what to do."""


class CallRefusedError(FailoverError):
    """The driver got the message, did not carry it out or failed at it, and says why.

    Attributes:
        kind: one word for programs: "failed", "unknown_verb", "bad_body", "busy", "expired" …
    """

    def __init__(self, message: str, kind: str = "") -> None:
        super().__init__(message)
        self.kind = kind


class NoAnswerError(FailoverError, TimeoutError):
    """A driver did not answer in time; whether the message was carried out is not known."""


class PageError(FailoverError):
    """The operators' page cannot be served as it was asked for, or a request of it is refused; the message says what to do."""


class SimulationError(FailoverError):
    """A simulation of robots cannot begin or go on; the message says why, and what to do."""


class ProgramError(FailoverError):
    """Something about a program that is sent to a robot does not work, and nothing changed; the message says what to do."""


class BundleRefusedError(ProgramError):
    """A bundle may not run here; the message says why. Nothing of it was unpacked."""


class StateError(FailoverError):
    """Something about the state that a program keeps (``failover.state``) does not work.

    Attributes:
        place: where in the state, as the program would write it: "mapper.plan[3].image"; "" for the state as a whole.
    """

    def __init__(self, message: str, place: str = "") -> None:
        super().__init__(message)
        self.place = place


class SchemaError(StateError):
    """A program declares to keep what cannot be kept; found when it starts, before anything is stored."""


class KeepError(StateError):
    """A value cannot be kept as it was declared; the commit was not made, and the last one stands."""


class FitError(StateError):
    """A stored state does not fit what the program declares; nothing was built of it, and it is still stored."""


class StateFormatError(StateError):
    """Bytes that are not a whole state of a version that we read; nothing was built of them."""


class TaskError(FailoverError):
    """A program that keeps its state used the interface in a way that cannot work; nothing was stored or lost."""


class StateTakenError(TaskError):
    """Another process keeps the state of this name."""


class NotCommittedError(FailoverError, TimeoutError):
    """A commit is not known to survive yet; the program may go on, or wait again."""


class GatewayError(FailoverError):
    """A gateway cannot decide: its file cannot be used, or what came is no epoch. Nothing may be obeyed."""


class StaleEpochError(FailoverError):
    """A command comes from a program that was replaced: another primary has given one of a later epoch.

    Attributes:
        epoch: of the command.
        newest: of the other one.
    """

    def __init__(self, epoch: int, newest: int) -> None:
        super().__init__(f"epoch {epoch} is over, {newest} has begun: another robot runs this program now")
        self.epoch = epoch
        self.newest = newest
