"""Functions in child processes: crashes, limits, and no process left behind.

The function is ``eval``, which needs no import that would take seconds.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gamba_warp.untrusted.children import Failed, run_each

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs /proc, and Linux's limits")
PID, FOLDER = "__import__('os').getpid()", "__import__('os').getcwd()"
CRASH, EXIT = "__import__('signal').raise_signal(11)", "__import__('os')._exit(3)"


def test_a_death_is_one_failure_and_errors_are_one_line():
    words = ["1", CRASH, "2", EXIT, "[][1]", "int('x\\ny')", "3"]
    found = dict(run_each(eval, words, workers=2))
    assert [found[i] for i in (0, 2, 6)] == [1, 2, 3]
    assert found[1] == Failed("its process died of signal 11 (SIGSEGV)")
    assert found[3] == Failed("its process ended with exit code 3")
    assert found[4] == Failed("IndexError: list index out of range")
    assert found[5].reason.startswith("ValueError: invalid literal") and "\n" not in found[5].reason


@linux
def test_one_that_hangs_is_ended():
    words = [PID, "__import__('time').sleep(60)", PID]
    found = dict(run_each(eval, words, seconds=0.5))
    assert found[1] == Failed("took more than 0.5 seconds") and found[0] != found[2]
    assert not Path(f"/proc/{found[0]}").exists()  # no zombie either


def test_a_child_is_kept_and_follows_its_parent(tmp_path, monkeypatch, capfd):
    first = dict(run_each(eval, [PID, "print('a library talks')"]))[0]
    monkeypatch.chdir(tmp_path)
    assert dict(run_each(eval, [PID, FOLDER])) == {0: first, 1: str(tmp_path)}
    assert first != os.getpid() and "talks" not in capfd.readouterr().out


@linux
def test_memory_has_a_limit():
    words = ["len(bytes(1 << 30))", "10"]
    found = dict(run_each(eval, words, memory=1 << 29))
    assert found == {0: Failed("not enough memory"), 1: 10}
    assert dict(run_each(eval, words[:1])) == {0: 1 << 30}  # the limit was that call's


def test_a_caller_that_stops_leaves_nothing_at_work():
    found = run_each(eval, ["0", "__import__('time').sleep(60)"], workers=2)
    next(found)
    start = time.monotonic()
    found.close()
    assert time.monotonic() - start < 10


def test_what_cannot_be_sent_is_the_callers_error():
    with pytest.raises(Exception, match="pickle|local object"):  # by the version of Python
        list(run_each(lambda item: item, [1]))


@linux
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_children_end_with_their_parent(tmp_path, number):
    script = tmp_path / "parent.py"
    told = f"__import__('os').write(2, b'%d\\n' % {PID})"  # at once: two lines never mix
    busy = f"({told}, sum(0 for _ in iter(int, 1)))"  # for ever
    script.write_text(
        "import sys\n"
        f"sys.path[:] = {sys.path!r}\n"
        "from gamba_warp.untrusted.children import run_each\n"
        "if __name__ == '__main__':\n"
        f"    next(run_each(eval, {[busy] * 2!r}, workers=2))\n"
    )
    parent = subprocess.Popen([sys.executable, script], stderr=subprocess.PIPE, text=True)
    children = [int(parent.stderr.readline()) for _ in range(2)]
    parent.send_signal(number)
    try:
        parent.wait(20)
    finally:
        parent.kill()
        parent.communicate()
    deadline = time.monotonic() + 20
    while left := [pid for pid in children if _runs(pid)]:
        assert time.monotonic() < deadline, left
        time.sleep(0.02)


def _runs(pid):
    """True if a process runs and is not a zombie, which a container may never reap."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
