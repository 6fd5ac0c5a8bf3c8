"""The publisher's session, opened while the rest of the service still loads."""

import socket
import subprocess
import sys

import zenoh
from zenoh.handlers import FifoChannel

from service.loopback import free_locator
from service.publish_config import PublishConfig
from service.publisher import Publisher
from service.session import open_session
from service.session_ahead import SessionAhead
from service.topics import robot_key

UNUSED = """
from service.loopback import free_locator
from service.publish_config import PublishConfig
from service.session_ahead import SessionAhead
SessionAhead(PublishConfig(listen=["tcp/127.0.0.1:0"]))
"""


def test_who_connects_before_the_publisher_is_there_hears_it_come() -> None:
    """A subscriber's session opens at once, and stays: the publisher speaks in the session that was opened ahead."""
    address = free_locator()
    ahead = SessionAhead(PublishConfig(listen=[address]))
    ahead.wait()
    with open_session("client", connect=[address]) as session:
        heard: FifoChannel[zenoh.Sample] = FifoChannel(16)
        token = session.liveliness().declare_subscriber(robot_key("rover"), heard, history=True)
        publisher = Publisher(PublishConfig(listen=[address]), "rover", ahead=ahead)
        publisher.start()
        try:
            assert token.recv().kind == zenoh.SampleKind.PUT
        finally:
            publisher.close()
        assert token.recv().kind == zenoh.SampleKind.DELETE


def test_an_address_in_use_is_told_by_the_publisher_that_was_to_use_it() -> None:
    """... in the words that it has for an address that it opens itself."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = PublishConfig(listen=[f"tcp/127.0.0.1:{taken.getsockname()[1]}"])
        publisher = Publisher(config, "rover", ahead=SessionAhead(config))
        publisher.start()
        assert "the address is in use; stop the program" in str(publisher.state()["failure"])
        publisher.close()


def test_a_session_that_nobody_used_ends_with_the_process() -> None:
    """A start that fails after the session was begun (a wrong DBC file) ends as it should, not in an abort."""
    subprocess.run([sys.executable, "-c", UNUSED], timeout=100, check=True)
