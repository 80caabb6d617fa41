"""A Python whose processes are forked from one that has loaded torch and Warp.

``python()`` is a program like ``sys.executable``, without the seconds that a fresh process takes to
import these libraries. The package itself and the libraries of its extras are not loaded before the
fork. The program is a small process that passes its arguments, environment, folder and streams
to the server, forwards signals, and ends like the forked process, which is killed with it.
"""

import contextlib
import json
import os
import signal
import socket
import sys
from functools import cache

# An optimizer loads torch._dynamo.
_LIBRARIES = (
    *("numpy", "PIL.Image", "safetensors.torch", "torch", "torch._dynamo", "torch.distributed"),
    *("torch.utils.data", "tqdm", "tyro", "warp"),
)
_ASKING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@cache
def python(*more: str) -> str:
    """Start the server, which ends with this process; return the path of the program.

    ``more`` are further modules that it loads before the fork.
    """
    import atexit
    import shlex
    import shutil
    import subprocess
    import tempfile

    folder = tempfile.mkdtemp(prefix="forked-")
    address, program = (os.path.join(folder, name) for name in ("socket", "python"))
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen(100)
        server = subprocess.Popen(
            [sys.executable, __file__, "--serve", str(listener.fileno()), *more],
            env=plain,
            pass_fds=[listener.fileno()],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
    atexit.register(shutil.rmtree, folder)
    atexit.register(server.communicate)  # closes its stdin, and waits
    with open(program, "w", opener=lambda path, flags: os.open(path, flags, 0o755)) as file:
        words = shlex.join([sys.executable, "-S", __file__, address])
        file.write(f'#!/bin/sh\nexec {words} "$@"\n')
    return program


def _ask(address: str, words: list[str]) -> None:
    """Have the server run a command, and end as it ends."""
    ignored = [number for number in _ASKING if signal.getsignal(number) == signal.SIG_IGN]
    request = os.memfd_create("request")
    os.write(request, json.dumps([words, dict(os.environ), os.getcwd(), ignored]).encode())
    with socket.socket(socket.AF_UNIX) as server:
        server.connect(address)
        for number in {*_ASKING} - {*ignored}:
            signal.signal(number, lambda number, _: server.send(bytes([number])))
        socket.send_fds(server, [b"."], [0, 1, 2, request])
        with server.makefile() as answer:
            code = int(answer.readline() or 1)
    if code < 0:
        with contextlib.suppress(OSError):  # SIGKILL has no handler
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _serve(listener: socket.socket) -> list[int]:
    """Fork a process for each request until stdin is closed; there return its descriptors."""
    import select

    sources, running = [listener, sys.stdin], {}
    while sources or running:
        sockets = [connection for _, connection in running.values()]
        ready = select.select([*sources, *running, *sockets], [], [])[0]
        if sys.stdin in ready:
            sources = []
        elif listener in ready:
            connection = listener.accept()[0]
            given = socket.recv_fds(connection, 1, 4)[1]
            if (child := os.fork()) == 0:
                return given
            [*map(os.close, given)]
            running[os.pidfd_open(child)] = child, connection
        for end in running.keys() & {*ready}:
            child, connection = running.pop(end)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            os.close(end)
            with contextlib.suppress(OSError), connection:
                connection.sendall(b"%d\n" % code)
        for child, connection in running.values():
            if connection in ready:
                asked = connection.recv(1)
                with contextlib.suppress(ProcessLookupError):
                    # Without an answer the process of the command was killed.
                    os.kill(child, asked[0]) if asked else os.killpg(child, signal.SIGKILL)
    os._exit(0)


def _become(*given: int) -> list[str]:
    """Take the streams, environment, folder and signals of a request; return its words."""
    import tempfile

    import torch

    os.setsid()
    for target, (stream, name) in enumerate(zip(given, ("stdin", "stdout", "stderr"))):
        os.dup2(stream, target)
        os.close(stream)
        errors = "backslashreplace" if target == 2 else "strict"
        new = open(target, "w" if target else "r", encoding="utf-8", errors=errors, closefd=False)
        setattr(sys, name, new)
        setattr(sys, f"__{name}__", new)
    sys.stderr.reconfigure(line_buffering=True)
    with open(given[3], "rb") as file:
        words, environment, folder, ignored = json.loads(os.pread(file.fileno(), 1 << 24, 0))
    for number in _ASKING:
        default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in ignored else default)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None  # TMPDIR is read anew
    if "OMP_NUM_THREADS" in environment:
        torch.set_num_threads(int(environment["OMP_NUM_THREADS"]))
    first = {"-c": "", "-m": folder}.get(words[0], os.path.dirname(words[0]))
    sys.path[:1] = [first, *filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))]
    return words


def _run(kind: str, *words: str) -> int | str | None:
    """Run ``-c CODE ..``, ``-m MODULE ..`` or ``SCRIPT ..``; return what it exits with."""
    import runpy
    import traceback
    import types

    sys.argv = [kind, *(words[1:] if kind in ("-c", "-m") else words)]
    try:
        if kind == "-c":
            module = sys.modules["__main__"] = types.ModuleType("__main__")
            exec(words[0], vars(module))
        elif kind == "-m":
            runpy.run_module(words[0], run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(kind, run_name="__main__")
    except SystemExit as end:
        return end.code
    except BaseException:
        traceback.print_exc()
        return 1


def main() -> None:
    """Be the program; or the server, and each of its processes."""
    import atexit
    import gc
    import importlib
    import threading

    place, *words = sys.argv[1:]
    if place != "--serve":
        _ask(place, words)
    for name in (*_LIBRARIES, *words[1:]):
        importlib.import_module(name)
    gc.freeze()
    code = _run(*_become(*_serve(socket.socket(fileno=int(words[0])))))
    if isinstance(code, str):
        print(code, file=sys.stderr)
    with contextlib.suppress(OSError, ValueError):
        threading._shutdown()
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))  # at once


if __name__ == "__main__":
    main()
