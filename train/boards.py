"""Boards that show a run while it goes on: TensorBoard, and Weights & Biases.

A board is written beside the run's own log and may fail; ``RunLog`` then goes on without it.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import msgspec

from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.untrusted.documents import read_document
from gamba_warp.versions import to_install


def check_boards(names: Sequence[str]) -> None:
    """Refuses a board that was asked for by name and is not installed, before a run begins.

    Raises:
        UserError: it says how to install it.
    """
    if "wandb" in names and find_spec("wandb") is None:
        raise UserError(f"--log wandb: it is not installed: {to_install('wandb')}")


def open_board(name: str, run: Path) -> TensorBoard | Wandb | None:
    """Opens "tensorboard" or "wandb" for a run's folder; None if TensorBoard is not installed.

    Raises:
        Exception: whatever stops it; so may what is made, in ``write`` and ``close``.
    """
    if name == "wandb":
        return Wandb(run)
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return TensorBoard(SummaryWriter(str(run / "tensorboard")))


def _scalars(event: str, values: Mapping[str, object]) -> dict[str, float]:
    """The numbers of a line, as ``event/name``."""
    return {
        f"{event}/{name}": value
        for name, value in values.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }


class TensorBoard:
    """Files for TensorBoard, in ``RUN/tensorboard``."""

    def __init__(self, writer: Any) -> None:
        """Takes a ``SummaryWriter``."""
        self.writer = writer

    def write(self, event: str, step: int, values: Mapping[str, object]) -> None:
        """Writes the numbers of a line."""
        for name, value in _scalars(event, values).items():
            self.writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Closes the files."""
        self.writer.close()


class _Known(msgspec.Struct):
    """``RUN/wandb.json``: by it a resumed run goes on where it stood."""

    id: Annotated[str, msgspec.Meta(pattern="^[0-9a-z]{1,64}$")]


class Wandb:
    """A run of Weights & Biases, whose own files lie in ``RUN/wandb``.

    Where it goes (server, project, online or not) is said by wandb's own settings, such as the
    environment's ``WANDB_PROJECT`` and ``WANDB_MODE``.
    """

    def __init__(self, run: Path) -> None:
        """Begins a run, or goes on with the one that ``RUN/wandb.json`` names."""
        import wandb  # pyright: ignore[reportMissingImports]: optional

        path = run / "wandb.json"
        try:
            number = read_document(path, _Known).id
        except UserError:  # there is none, or it is damaged
            number = secrets.token_hex(8)
            write_json(path, {"id": number})
        # Its own way of catching the output would break the progress bar; it asks nobody for long.
        quiet = wandb.Settings(console="off", silent=True, save_code=False, login_timeout=30)
        place = {"dir": str(run), "id": number, "name": run.resolve().name}
        self.run = wandb.init(**place, resume="allow", settings=quiet)
        # Not wandb's own count of steps, which cannot go back to that of a checkpoint.
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")
        self._code = 1  # of a run that does not come to its end

    def write(self, event: str, step: int, values: Mapping[str, object]) -> None:
        """Sends the numbers of a line, and at the start the configuration."""
        if event == "start":
            self.run.config.update(values.get("config", {}), allow_val_change=True)
        if event == "end":
            self._code = values.get("code", 1)
        self.run.log({"step": step, **_scalars(event, values)})

    def close(self) -> None:
        """Ends the run; without it, wandb says that it crashed."""
        self.run.finish(exit_code=self._code)
