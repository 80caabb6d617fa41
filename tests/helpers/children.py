"""Functions for child processes, which find them by name: some end the process they run in."""

import os
import signal


def murderous_pair(pair, protocol, motion):
    """Evaluates a pair; one whose name begins with ``bad`` kills the process."""
    from gamba_warp.eval.shapes.pairs import evaluate_pair

    if pair.name.startswith("bad"):
        signal.raise_signal(signal.SIGSEGV)
    return evaluate_pair(pair, protocol, motion)


def talking_pair(pair, protocol, motion):
    """Evaluates a pair, and prints; one of the name ``bad`` raises what nobody expects."""
    from gamba_warp.eval.shapes.pairs import evaluate_pair

    os.write(1, b"a library talks\n")
    if pair.name == "bad":
        raise MemoryError("no room")
    return evaluate_pair(pair, protocol, motion)


def murderous_object(mesh, out, settings, threads):
    """Renders an object; that with the uid ``b`` kills the process."""
    from gamba_warp.train.data.render import render_object

    if mesh.uid == "b":
        signal.raise_signal(signal.SIGKILL)
    return render_object(mesh, out, settings)
