"""``gamba endurance``: every writing command killed at random moments, and on a full disk."""

from __future__ import annotations

from pathlib import Path

from ..errors import UserError
from ..files import output_folder, write_json, write_text


def endurance_command(
    quick: bool = False,
    out: Path = Path("out/endurance"),
    commands: tuple[str, ...] = (),
    seed: int = 0,
) -> int:
    """Kills every writing command at random moments and fills the disk under it, and counts.

    Training is killed 100 times and must come to the same bits as if nothing had happened, and so
    must two processes of which one is killed 10 times; every other command is killed 20 times;
    each meets a full disk (no file may grow beyond a random byte) 10 times. Counted are older files
    lost, runs that did not go on, ends that were not told in one line, and debris. Writes
    endurance.json and endurance.md. Works in a temporary folder. Runs on Linux only.

    Args:
        quick: A few of each, which takes seconds.
        out: Folder for the results.
        commands: Only these besides training; all if not given.
        seed: Seed of the random moments.
    """
    import sys
    import tempfile

    from ..endurance.jobs import jobs
    from ..endurance.report import page
    from ..endurance.run import Plan, endurance

    if sys.platform != "linux":
        raise UserError("endurance runs on Linux only: it forks commands and limits their files")
    known = [job.name for job in jobs(Path())]
    unknown = [name for name in commands if name not in known]
    if unknown:
        raise UserError(f"--commands {unknown[0]}: there are {', '.join(known)}")
    if not 0 <= seed < 2**63:
        raise UserError(f"--seed {seed}: must be 0 or more, below 2^63")
    folder = output_folder(out)
    chosen = commands or (("reconstruct",) if quick else ())
    plan = Plan(4, 2, 2, chosen, seed) if quick else Plan(100, 20, 10, chosen, seed, 10)
    with tempfile.TemporaryDirectory(prefix="gamba-endurance-") as world:
        result = endurance(Path(world), plan)
    write_json(folder / "endurance.json", result)
    write_text(folder / "endurance.md", page(result))
    print(page(result))
    print(f"{result['seconds']:.0f} s; wrote {folder / 'endurance.json'} and endurance.md")
    bad = ("lost", "not_resumed", "untold", "debris")
    return 1 if any(count[name] for count in result["counts"] for name in bad) else 0
