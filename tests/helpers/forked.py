"""A Python whose processes are forked from one that has loaded torch and Warp.

``python()`` is a program like ``sys.executable``, without the seconds that a fresh process takes to
import these libraries. The package itself and the libraries of its extras are not loaded before the
fork. The program is a small process that passes its arguments, environment, folder and streams
to the server, forwards signals, and ends like the forked process, which is killed with it.
"""

import atexit
import contextlib
import functools
import json
import os
import signal
import socket
import sys

# An optimizer loads torch._dynamo.
_LIBRARIES = (
    *("numpy", "PIL.Image", "safetensors.torch", "torch", "torch._dynamo", "torch.distributed"),
    *("torch.utils.data", "tqdm", "tyro", "warp"),
)
_ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@functools.cache
def python() -> str:
    """Start the server, which ends with this process; return the path of the program."""
    import shlex
    import subprocess
    import tempfile

    folder = tempfile.TemporaryDirectory(prefix="forked-")
    address = os.path.join(folder.name, "socket")
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    server = subprocess.Popen(
        [sys.executable, __file__, address],
        env=plain,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    assert server.stdout.read(1) == b"1"  # it listens
    server.stdout.close()

    @atexit.register
    def end():
        server.stdin.close()
        server.wait()
        folder.cleanup()

    program = os.path.join(folder.name, "python")
    with open(program, "w", opener=lambda path, flags: os.open(path, flags, 0o755)) as file:
        words = shlex.join([sys.executable, "-S", __file__, address])
        file.write(f'#!/bin/sh\nexec {words} "$@"\n')
    return program


def _ask(address: str, words: list[str]) -> None:
    """Have the server run a command, and end as it ends."""
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(address)
        ignored = [number for number in _ASKING if signal.getsignal(number) == signal.SIG_IGN]
        for number in {*_ASKING} - {*ignored}:
            signal.signal(number, lambda number, _: server.send(bytes([number])))
        request = json.dumps([words, dict(os.environ), os.getcwd(), ignored]).encode() + b"\n"
        socket.send_fds(server, [request[:1]], [0, 1, 2])
        server.sendall(request[1:])
        with server.makefile() as answer:
            code = int(answer.readline() or 1)
    if code < 0:
        with contextlib.suppress(OSError):  # SIGKILL has no handler
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _serve(address: str) -> None:
    """Fork a process for each connection until stdin is closed."""
    import gc
    import importlib
    import select

    for name in _LIBRARIES:
        importlib.import_module(name)
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen(100)
        os.write(1, b"1")
        while sys.stdin not in select.select([listener, sys.stdin], [], [])[0]:
            connection = listener.accept()[0]
            if os.fork() == 0:
                listener.close()
                os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
                _watch(connection)
                os._exit(0)
            connection.close()
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass
        with contextlib.suppress(ChildProcessError):
            while os.wait():
                pass


def _watch(connection: socket.socket) -> None:
    """Fork the process of one request, forward signals to it, and answer with its exit code."""
    import select

    request, streams, _, _ = socket.recv_fds(connection, 1, 3)
    while not request.endswith(b"\n"):
        part = connection.recv(1 << 16)
        if not part:
            return
        request += part
    child = os.fork()
    if child == 0:
        connection.close()
        _become(streams, *json.loads(request))
    for stream in streams:
        os.close(stream)
    end = os.pidfd_open(child)
    while end not in select.select([end, connection], [], [])[0]:
        asked = connection.recv(1)
        with contextlib.suppress(ProcessLookupError):
            if not asked:  # the process of the command was killed
                os.killpg(child, signal.SIGKILL)
                break
            os.kill(child, asked[0])
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with contextlib.suppress(OSError):
        connection.sendall(b"%d\n" % code)


def _become(streams, words, environment, folder, ignored) -> None:
    """Run Python's words ``-c CODE ..``, ``-m MODULE ..`` or ``SCRIPT ..``; does not return."""
    import runpy
    import tempfile
    import threading
    import traceback
    import types

    import torch

    os.setsid()
    for number in _ASKING:
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in ignored else default)
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
        os.close(stream)
        name, kind = ("stdin", "stdout", "stderr")[target], "w" if target else "r"
        errors = "backslashreplace" if target == 2 else "strict"
        new = open(target, kind, encoding="utf-8", errors=errors, closefd=False)
        setattr(sys, name, new)
        setattr(sys, f"__{name}__", new)
    sys.stderr.reconfigure(line_buffering=True)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # TMPDIR is read anew
    if "OMP_NUM_THREADS" in environment:
        torch.set_num_threads(int(environment["OMP_NUM_THREADS"]))
    if words[0] == "-u":
        del words[0]
        sys.stdout.reconfigure(write_through=True)
    kind = words.pop(0) if words[0] in ("-c", "-m") else ""
    first = {"-c": "", "-m": folder}.get(kind, os.path.dirname(words[0]))
    sys.path[:1] = [first, *filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))]
    sys.argv = [kind or words[0], *words[1:]]
    code = 0
    try:
        if kind == "-c":
            sys.modules["__main__"] = types.ModuleType("__main__")
            exec(words[0], sys.modules["__main__"].__dict__)
        elif kind == "-m":
            runpy.run_module(words[0], run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(words[0], run_name="__main__")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    with contextlib.suppress(OSError, ValueError):
        threading._shutdown()
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    _ask(sys.argv[1], sys.argv[2:]) if len(sys.argv) > 2 else _serve(sys.argv[1])
