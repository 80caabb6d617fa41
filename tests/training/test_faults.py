"""Training on a full disk, beside another trainer, and under a closed terminal."""

import json
import os
import signal
from unittest.mock import Mock

import pytest
import torch
from helpers.disk import full_at
from helpers.micro import run
from helpers.refusals import refused

from gamba_warp import cli
from gamba_warp.files import PART, only_process
from gamba_warp.processes import stop_requests
from gamba_warp.train.checkpoint import list_checkpoints
from gamba_warp.train.log import RunLog, SafeStream, say


def leftovers(folder):
    return [path for path in folder.rglob("*") if path.name.startswith(PART)]


def tree(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.99])
def test_a_full_disk_ends_training_in_one_line_with_the_checkpoint_whole(data, tmp_path, fraction):
    out = tmp_path / "run"
    assert run(data, out, length={"steps": 3}) == 0
    (saved,) = list_checkpoints(out)
    before = tree(saved)
    limit = int(fraction * max(len(content) for content in before.values()))
    with full_at(max(limit, 4096)):  # the log has room
        refused("cannot write", run, data, out, length={"steps": 5})
    assert list_checkpoints(out) == [saved] and tree(saved) == before and not leftovers(out)
    assert run(data, out, length={"steps": 5}) == 0


def test_a_log_that_cannot_be_written_is_said_once_and_training_goes_on(data, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "log.jsonl").symlink_to("/dev/full")
    assert run(data, out, length={"steps": 3}) == 0
    said = capsys.readouterr().out
    line = "log.jsonl cannot be written, the run continues: No space left on device"
    assert said.count(line) == 1


def test_a_log_is_of_whole_lines_whatever_happens(tmp_path, capsys):
    path = tmp_path / "log.jsonl"
    path.write_bytes(b'{"event": "a"}\n{"event": "torn')  # by a kill
    log = RunLog(tmp_path)
    log.write("b", 1)
    with full_at(path.stat().st_size + 10):
        log.write("c", 2)
        log.write("c", 3)
    log.write("d", 4, loss=0.5)
    log.close()
    events = [json.loads(line)["event"] for line in path.read_text().splitlines()]
    assert events == ["a", "b", "d"]
    assert capsys.readouterr().out.count("cannot be written") == 1


def test_tensorboard_never_stops_a_run(tmp_path, capsys):
    pytest.importorskip("tensorboard")
    log = RunLog(tmp_path)
    log._board.add_scalar = Mock(side_effect=OSError(28, "No space left on device"))
    for step in range(3):
        log.write("train", step, loss=1.0)
    log.close()
    assert capsys.readouterr().out.count("tensorboard cannot be written") == 1


def test_sample_images_never_stop_a_run(tmp_path, capsys):
    log = RunLog(tmp_path)
    log.sample(7, tmp_path / "none" / "a.png", [torch.rand(2, 4, 4, 3)])
    assert "cannot write" in capsys.readouterr().out


def test_a_closed_terminal_stops_nothing():
    with open("/dev/full", "w", buffering=1) as full:
        say("a line", full)
        SafeStream(full).write("a bar\n")
        SafeStream(full).flush()
        with pytest.raises(OSError):
            full.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())  # so that it closes


def test_a_second_trainer_is_refused_and_a_dead_one_is_not_waited_for(data, tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / ".lock").write_text("999999999\n")  # of a process that died
    arguments = [str(data), "--out", str(out), "--device", "cpu", "--steps", "1"]
    with only_process(out, "trains"):
        assert cli.run("train", arguments) == 2
    said = f"gamba: {out}: another process trains here (pid {os.getpid()})\n"
    assert capsys.readouterr().err == said
    assert os.listdir(out) == [".lock"]
    assert run(data, out, length={"steps": 1}) == 0


def test_what_killed_processes_left_goes_when_training_starts(data, tmp_path):
    out = tmp_path / "run"
    for folder in (out, out / "samples", out / "checkpoints"):
        (folder / f"{PART}abcd1234").mkdir(parents=True)
        (folder / f"{PART}abcd1234" / "model.safetensors").write_bytes(b"half")
    assert run(data, out, length={"steps": 1}) == 0 and not leftovers(out)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_each_signal_saves_and_stops(no_nohup, number):
    with stop_requests(insist=True) as received:
        os.kill(os.getpid(), number)
        assert received == [number]
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_nohup_holds(no_nohup):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_requests():
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
