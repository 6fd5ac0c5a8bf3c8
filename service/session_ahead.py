"""A Zenoh session that opens while those who will use it still load.

Who looks for the robot finds it that much sooner: a subscriber that is refused tries again only after a while.
"""

import atexit
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import zenoh

from service.publish_config import PublishConfig
from service.session import open_session


class SessionAhead:
    """The publisher's first session, opened on a thread of its own."""

    def __init__(self, config: PublishConfig) -> None:
        """Begin to open it."""
        self._config = config
        self._opened = ExitStack()
        self._session: zenoh.Session | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._open, name="session", daemon=True)
        # A thread that is inside Zenoh when the interpreter ends would abort the process.
        atexit.register(self.close)
        self._thread.start()

    def wait(self) -> None:
        """Return when it is open, or has failed."""
        self._thread.join()

    @contextmanager
    def session(self) -> Iterator[zenoh.Session]:
        """The session, closed at the end of the block. Raises LinkError as `open_session` does."""
        self.wait()
        if self._session is None:
            assert self._failure is not None
            raise self._failure
        try:
            yield self._session
        finally:
            self.close()

    def close(self) -> None:
        """Close it, whether or not it was used."""
        atexit.unregister(self.close)
        self.wait()
        self._opened.close()

    def _open(self) -> None:
        config = self._config
        try:
            opening = open_session("peer", config.listen, config.connect, config.multicast)
            self._session = self._opened.enter_context(opening)
        except BaseException as error:
            self._failure = error
