"""Commands in child processes, and functions for these by name; some kill their process."""

import os
import signal
import subprocess


def ran(*words, timeout=300, **options):
    """Run a command, and return its end with both outputs as text."""
    command = [*map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, **options)


def faulty_pair(pair, protocol, motion):
    """Evaluate a pair, and print; one named ``bad`` kills the process, ``odd`` raises an error."""
    from gamba_warp.eval.shapes.pairs import evaluate_pair

    os.write(1, b"a library talks\n")
    if pair.name == "odd":
        raise MemoryError("no room")
    if pair.name == "bad":
        signal.raise_signal(signal.SIGSEGV)
    return evaluate_pair(pair, protocol, motion)


def murderous_object(mesh, out, settings, threads):
    """Render an object; that with the uid ``b`` kills the process."""
    from gamba_warp.train.data.render import render_object

    if mesh.uid == "b":
        signal.raise_signal(signal.SIGKILL)
    return render_object(mesh, out, settings)
