"""Two services under one robot's name: both sides notice, and a copy keeps to one of them."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest
import zenoh

from estimator.bounded_pose import INTACT, BoundedPose
from service.client import RemoteMap
from service.loopback import free_locator
from service.map_update import MapUpdate
from service.publish_config import PublishConfig
from service.publisher import Publisher
from service.rivals import SILENT_NS, STRAGGLING_NS, FollowedRun

PATIENCE_S = 60.0
SECOND = 1_000_000_000
RIVAL = """
import sys
import threading
import numpy as np
from estimator.bounded_pose import INTACT, Anchor, BoundedPose
from service.map_update import MapUpdate
from service.publish_config import PublishConfig
from service.publisher import Publisher
publisher = Publisher(PublishConfig(listen=[], connect=[sys.argv[1]], digest_period_s=0.2), "rover", {"host": "twin"})
publisher.start()
print("there", flush=True)
end = threading.Event()
def tell():
    while not end.wait(0.02):
        pose = BoundedPose(1, 2, np.full(6, 7.0), np.full(6, 8.0))
        anchor = Anchor(7.0, 7.0, 7.0, np.zeros(4), np.ones(4))
        publisher.offer(MapUpdate((), pose, anchor, {"whose": "twin"}, INTACT, 1))
teller = threading.Thread(target=tell)
teller.start()
sys.stdin.read()
end.set()
teller.join()
publisher.close()
"""


@contextmanager
def router() -> Iterator[str]:
    """Where robots and those who watch them meet."""
    address, config = free_locator(), zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([address]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        yield address


@contextmanager
def rival(address: str) -> Iterator[None]:
    """A second publisher of the same name, in a process of its own."""
    command = [sys.executable, "-c", RIVAL, address]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        yield
        process.communicate(timeout=PATIENCE_S)


def wait_until(condition: Callable[[], object]) -> None:
    """Fail when it doesn't come true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("meeting", ["at a router", "directly"])
def test_two_services_of_one_name_are_told(meeting: str) -> None:
    """The copy stays with one run, and says whose it is; a service that hears the other names its host and the key."""
    with ExitStack() as stack:
        address = stack.enter_context(router()) if meeting == "at a router" else free_locator()
        listen, connect = ([], [address]) if meeting == "at a router" else ([address], [])
        config = PublishConfig(listen=listen, connect=connect, digest_period_s=0.2)
        publisher = Publisher(config, "rover", {"host": "me"})
        publisher.start()
        stack.callback(publisher.close)
        remote = stack.enter_context(RemoteMap(address))
        assert remote.wait_for_digest(PATIENCE_S)
        assert (publisher.rival, remote.rival) == (None, None)
        with rival(address):
            if meeting == "directly":
                wait_until(lambda: publisher.rival is not None)
                assert "on the host twin" in str(publisher.rival)
                assert "robot.name" in str(publisher.rival)
                assert publisher.state()["rival"] == publisher.rival
            wait_until(lambda: remote.rival is not None)
            told = str(remote.rival)
            assert "two services publish as 'rover'" in told
            assert "on the host twin" in told
            assert "on the host me" in told
            begun, ignored = remote.counts["epochs"], remote.counts["left_epoch"]
            wait_until(lambda: remote.counts["left_epoch"] > ignored + 5)
            assert remote.counts["epochs"] == begun  # it doesn't begin anew with each message


def test_where_two_services_publish_a_copy_tells_of_one_alone() -> None:
    """Poses, anchor and health are those of the run whose map it is: each pair lies in a frame of its own."""
    with ExitStack() as stack:
        address = stack.enter_context(router())
        stack.enter_context(rival(address))
        remote = stack.enter_context(RemoteMap(address))
        wait_until(lambda: remote.pose is not None and remote.anchor is not None and remote.health)
        # The one that was there before is followed no more: another has begun.
        publisher = Publisher(PublishConfig(listen=[], connect=[address], digest_period_s=0.2), "rover")
        publisher.start()
        stack.callback(publisher.close)
        wait_until(lambda: remote.info.get("epoch") == publisher.epoch)

        def more_than(left: int) -> bool:
            return remote.counts["left_epoch"] > left

        for number in range(1000, 1020):
            pose = BoundedPose(number, number + 1, np.zeros(6), np.ones(6))
            assert publisher.wait_until_ready(PATIENCE_S)
            assert publisher.offer(MapUpdate((), pose, None, {"whose": "ours"}, INTACT, 1))
            left = remote.counts["left_epoch"]
            wait_until(partial(more_than, left))
            assert remote.pose is None or remote.pose.earliest_ns >= 1000
            assert remote.anchor is None
            assert remote.health.get("whose") in (None, "ours")


@pytest.mark.parametrize("after_s", [0, 1, 3600])
def test_a_restart_is_no_rival(after_s: int) -> None:
    """The new run is followed at once; what the old one had sent straggles in, and is not told."""
    run = FollowedRun()
    assert run.hear("old", 0)
    restart_ns = after_s * SECOND
    assert run.hear("new", restart_ns)
    assert not run.hear("old", restart_ns + STRAGGLING_NS)
    assert (run.epoch, run.rival(restart_ns + STRAGGLING_NS)) == ("new", None)


def test_a_rival_is_told_while_it_is_heard_and_followed_once_it_is_alone() -> None:
    """The newest run stays followed as long as it speaks; then the other one is, and nothing is told any more."""
    run = FollowedRun()
    run.hear("one", 0)
    for second in range(1, 60):
        assert run.hear("two", second * SECOND)
        assert not run.hear("one", second * SECOND + 1)
        assert run.rival(second * SECOND + 1) == ("one" if second > 5 else None)
    quiet_ns = 59 * SECOND + SILENT_NS
    assert not run.hear("one", quiet_ns)
    assert run.hear("one", quiet_ns + 1)
    assert (run.epoch, run.rival(quiet_ns + 2)) == ("one", None)


def test_of_ever_so_many_runs_few_are_remembered() -> None:
    """A robot that is started again and again: memory is bounded, the newest is followed."""
    run = FollowedRun()
    assert all(run.hear(str(number), number) for number in range(10_000))
    assert run.left("9998")
    assert not run.left("0")
