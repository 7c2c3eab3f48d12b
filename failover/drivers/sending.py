"""Sends what one program has to tell one driver, over cuts and restarts, until each message is answered.

A call sends by the thread that calls. Once something was posted, one thread sends for all calls and posts of the proxy.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import UNSET

from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Encoding, Envelope
from failover.core.messaging.mailbox import MOVED, MS, NO_ANSWER, RESEND_FIRST_NS, RESEND_MOST_NS, Outbox, Outgoing
from failover.core.naming.tree import Place
from failover.drivers.here import Here
from failover.drivers.name_service import new_boot
from failover.drivers.route import LOOK_NS, Route
from failover.errors import CallRefusedError, DriverError, EnvelopeError, NoAnswerError

if TYPE_CHECKING:
    from failover.drivers.posts_file import PostsFile

SECOND_NS: Final = 1_000_000_000

SLICE_NS: Final = SECOND_NS // 2
"""How often a way is looked at while an answer is waited for: ZeroMQ does not tell that its connection is lost."""

MOVED_NS: Final = SECOND_NS // 5
"""Between two looks at the names, while a driver says that it has moved, and the names do not say yet where to."""

IDLE_NS: Final = 3_600 * SECOND_NS

EXPIRED: Final = "expired"

OUTLIVED: Final = "outlived"
"""Kind of the error of a driver that has heard a later life of the sender."""

log = logging.getLogger("failover.drivers")


class Sending:
    """What one sender has to tell one driver, and the way there. `post` may be called by any thread, `turn` by one at a time."""

    def __init__(
        self, here: Here, place: Place, sender: str, limit: int, encoding: Encoding = "json", *, is_durable: bool = False
    ) -> None:
        """
        Args:
            limit: messages that may wait for an answer.
            encoding: of messages; a driver that cannot read it gets JSON.
            is_durable: messages without an answer are kept in a file, and those that are there are sent first.

        Raises:
            DriverError: the driver is on another robot that cannot be reached, or the file cannot be used.
        """
        self.encoding: Encoding = encoding
        self.route = Route(here, place)
        self.path = self.route.path
        self.now_ns = self.route.now_ns
        self._file = self._opened(sender) if is_durable else None
        kept = self._file.kept if self._file is not None else Outgoing(new_boot())
        self.left_over = tuple(one.envelope.id for one in kept.waiting)
        """The ids of messages that an earlier process has posted, and that are sent now."""
        self._outbox = Outbox(sender, kept.boot, kept, limit)
        self._outbox.committed()
        self._lock = threading.Lock()
        self._epoch = place.record.epoch
        """The highest of the driver of which this sender has heard."""
        self._left = 0
        """The highest number of a message that was sent."""
        self._look_ns = self._heard_ns = 0
        self._pause_ns = RESEND_FIRST_NS

    def _opened(self, sender: str) -> PostsFile:
        from failover.drivers.posts_file import PostsFile  # only who keeps messages loads it

        try:
            return PostsFile(sender, self.path, new_boot(), self.now_ns())
        except BaseException:
            self.route.close()
            raise

    def close(self) -> None:
        """Let the connection go; what is in the file stays there."""
        self.route.close()
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None

    @property
    def is_durable(self) -> bool:
        """Whether messages without an answer outlive this process."""
        return self._file is not None

    @property
    def is_idle(self) -> bool:
        """Whether every message has its answer."""
        return not len(self._outbox)

    def post(self, envelope: Envelope, now_ns: int) -> Envelope:
        """Take a message that a later `turn` sends; it with its number and id.

        Raises:
            MailboxFullError: so many wait already as may.
            DriverError: it cannot be kept.
        """
        with self._lock:
            posted = self._outbox.post(envelope, now_ns)
            if self._file is not None:
                until_ns = None if posted.deadline_ms is None else now_ns + round(posted.deadline_ms * MS)
                try:
                    self._file.posted(posted, until_ns, now_ns)
                except BaseException:  # also Ctrl-C while it waits for the disk
                    self._outbox.withdrawn()
                    self._file.over(posted.seq)
                    raise
                self._outbox.committed()
            return posted

    def abandon(self) -> tuple[list[Envelope], list[Envelope]]:
        """Messages without an answer, which are forgotten: those that may have left, and those that have not."""
        with self._lock:
            return self._outbox.abandoned()

    def turn(self, until_ns: int, wake: int = -1) -> list[Envelope]:
        """Send what is due, then take in what comes, once it comes, until then at most.

        Args:
            wake: a descriptor that ends the wait, too.

        Returns:
            Final answers; also that a message expired before it left, or had none until long after its deadline.
        """
        now_ns = self.now_ns()
        if over := self._over(now_ns):
            return over
        if not self._outbox.is_connected:
            if (content := self.route.way.await_message(0)) is not None:  # said before the connection was lost
                return self._heard(content)
            if not self._await_open(until_ns, wake):
                return []
            now_ns = self.now_ns()
        self._send_due(now_ns, until_ns)
        if not self._outbox.is_connected:
            return []
        now_ns = self.now_ns()
        with self._lock:
            next_ns = self._outbox.next_ns()
        until_ns = min(until_ns, next_ns if next_ns is not None else until_ns, now_ns + SLICE_NS)
        content = self.route.way.await_message(max(until_ns - now_ns, 0), wake)
        if content is None:
            if self.route.way.is_lost:  # the driver has ended, or the network is cut: it is asked anew once it is there again
                self._disconnected()
            return []
        return self._heard(content)

    def _heard(self, content: bytes) -> list[Envelope]:
        """What the receiver has said: the final answer, or that it is busy; [] otherwise."""
        self._heard_ns = self.now_ns()
        answer = decoded(content)
        if answer is None:
            return []
        with self._lock:
            self._outbox.heard(self._heard_ns)
        kind = "" if answer.error is UNSET else answer.error.kind
        if kind == "no_message" and self.encoding != "json":
            self.encoding = "json"
            with self._lock:
                self._outbox.connected(self._heard_ns)  # all that has no answer is sent again
            return []
        if kind in MOVED:  # before the epoch is looked at: a copy that was replaced says it under its lower one
            self._moved()
        if 0 < answer.epoch < self._epoch:
            return []  # of a copy that was replaced: what it did is lost
        self._epoch = max(self._epoch, answer.epoch)
        with self._lock:
            is_final = self._outbox.answered(answer, self._heard_ns)
            if is_final and self._file is not None:
                answer = self._over_or_kept(self._file, answer, kind)
        return [answer] if is_final or kind == "busy" else []

    def _over_or_kept(self, file: PostsFile, answer: Envelope, kind: str) -> Envelope:
        """The final answer. A message that was refused for its sender's life alone stays in the file, and the answer says so."""
        if kind != OUTLIVED or answer.error is UNSET:
            file.over(answer.seq)
            return answer
        sentence = (
            f"{answer.error.sentence}; the message stays in {file.path}, without which its sender has run since: "
            "move it away, and what it holds is not sent"
        )
        return msgspec.structs.replace(answer, error=msgspec.structs.replace(answer.error, sentence=sentence))

    def _moved(self) -> None:
        """The driver is elsewhere: all that has no answer is sent there, in order."""
        if self._heard_ns >= self._look_ns:
            self._look_ns = self._heard_ns + MOVED_NS
            if self._look_again(self._heard_ns + LOOK_NS):
                self._disconnected()

    def _over(self, now_ns: int) -> list[Envelope]:
        with self._lock:
            late, lost = self._outbox.expired(now_ns), self._outbox.given_up(now_ns)
            if not (late or lost):
                return late
            if self._file is not None:
                for one in (*late, *lost):
                    self._file.over(one.seq)
        why = f"{self.path} has not answered, also after the deadline; it may have carried it out"
        return late + [envelopes.refusal(one, NO_ANSWER, why) for one in lost]

    def _await_open(self, until_ns: int, wake: int) -> bool:
        """Whether there is a connection by then; now and then the name is looked up anew."""
        now_ns = self.now_ns()
        with self._lock:
            next_ns = self._outbox.next_ns() or until_ns
        if self.route.way.await_open(max(min(until_ns, next_ns, self._look_ns) - now_ns, 0), wake):
            with self._lock:
                self._outbox.connected(self.now_ns())
            self._pause_ns = RESEND_FIRST_NS
            return True
        if self.now_ns() >= self._look_ns:
            self._look_again(until_ns)
            self._look_ns = self.now_ns() + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, RESEND_MOST_NS)
        return False

    def _disconnected(self, unsent: int = 0) -> None:
        with self._lock:
            self._outbox.returned(unsent)
        self._look_ns = self.now_ns() + self._pause_ns

    def _send_due(self, now_ns: int, until_ns: int) -> None:
        with self._lock:
            is_silent = self._outbox.must_look(now_ns)
        if is_silent:
            if self._look_again(min(until_ns, now_ns + LOOK_NS)):
                self._disconnected()
                return
            now_ns = self.now_ns()
        with self._lock:
            if self._file is None:
                self._outbox.committed()  # this sender keeps nothing: each answer that it has is had
            due = self._outbox.due(now_ns)
        for place, one in enumerate(due):
            if not self.route.way.send(self._encoded(one)):
                self._disconnected(len(due) - place)
                return
            self._left = max(self._left, one.seq)

    def _encoded(self, one: Envelope) -> bytes:
        """As it leaves now. Of one that is sent again the first stamp stays."""
        if self._epoch:
            one = msgspec.structs.replace(one, epoch=self._epoch)
        return envelopes.encode(envelopes.left(one, self.now_ns()), self.encoding)

    def _look_again(self, until_ns: int) -> bool:
        """It does not answer: whether it was found at another address."""
        is_elsewhere = self.route.look_again(until_ns - self.now_ns())
        if is_elsewhere:
            self._epoch = max(self._epoch, self.route.place.record.epoch)
        return is_elsewhere


class Posting:
    """The thread that sends what was posted, and gives each message's future its result."""

    def __init__(self, sending: Sending) -> None:
        self._sending = sending
        self._futures: dict[str, Future[Any]] = {name: Future() for name in sending.left_over}
        self.left_over = tuple(self._futures.values())
        """Of what an earlier process has posted and that had no answer, in order."""
        for future in self.left_over:
            future.set_running_or_notify_cancel()
        self._lock = threading.Lock()
        self._is_over = False
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._thread = threading.Thread(target=self._run, name="failover posts", daemon=True)
        self._thread.start()

    def post(self, envelope: Envelope, now_ns: int) -> Future[Any]:
        """Take a message; what comes of it.

        Raises:
            MailboxFullError: so many wait already as may.
            DriverError: the proxy was closed.
        """
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()  # what was sent cannot be taken back
        with self._lock:
            if self._is_over:
                raise DriverError(f"cannot post to {self._sending.path}: the proxy is closed; make a new one")
            self._futures[self._sending.post(envelope, now_ns).id] = future
            os.eventfd_write(self._wake, 1)
        return future

    def waiting(self) -> list[Future[Any]]:
        """Those without a result."""
        with self._lock:
            return list(self._futures.values())

    def close(self) -> None:
        """Send nothing more; futures without a result get an error that says whether the message may have been carried out."""
        with self._lock:
            if not self._is_over:
                self._is_over = True
                os.eventfd_write(self._wake, 1)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._wake, select.POLLIN)
        why = "the proxy was closed"
        try:
            while True:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._wake)
                if self._is_over:  # looked at after the read: a close in between is not lost
                    break
                if self._sending.is_idle:
                    poller.poll()
                    continue
                for answer in self._sending.turn(self._sending.now_ns() + IDLE_NS, self._wake):
                    self._done(answer)
        except Exception as error:
            log.exception("what was posted to %s is sent no more", self._sending.path)
            why = f"the thread that sends failed: {type(error).__name__}: {error}"
        self._end(why)

    def _done(self, answer: Envelope) -> None:
        if answer.error is not UNSET and answer.error.kind == "busy":
            return
        with self._lock:
            future = self._futures.pop(answer.re, None)
        if future is None:
            return
        if answer.error is UNSET:
            future.set_result(None if answer.ok is UNSET else answer.ok)
        else:
            future.set_exception(refused(answer))

    def _end(self, why: str) -> None:
        with self._lock:
            self._is_over = True
            is_kept = self._sending.is_durable
            left, _ = self._sending.abandon()
            futures, self._futures = self._futures, {}
            os.close(self._wake)
        may_be_done = {one.id for one in left}
        for name, future in futures.items():
            told = "it may have been carried out" if name in may_be_done else "it has not left"
            told += "; it is kept, and sent when its sender runs again" * is_kept
            future.set_exception(NoAnswerError(f"{self._sending.path} has not answered: {why}; {told}"))


def refused(answer: Envelope) -> CallRefusedError | NoAnswerError:
    """The error that an answer tells."""
    assert answer.error is not UNSET
    if answer.error.kind == NO_ANSWER:
        return NoAnswerError(answer.error.sentence)
    return CallRefusedError(answer.error.sentence or answer.error.kind, answer.error.kind)


def decoded(content: bytes) -> Envelope | None:
    """A message that came; None: it is none."""
    try:
        return envelopes.decode(content)
    except EnvelopeError:
        return None
