"""Live logging of a run to TensorBoard and to Weights & Biases.

A board is written beside the run's own log. If it fails, ``RunLog`` continues without it.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from gamba_warp.errors import UserError
from gamba_warp.files import write_json
from gamba_warp.untrusted.documents import read_document
from gamba_warp.versions import to_install


def check_boards(names: Sequence[str]) -> None:
    """Check before a run that the requested boards are installed.

    Raises:
        UserError: a board is missing; the message says how to install it.
    """
    if "wandb" in names and find_spec("wandb") is None:
        raise UserError(f"--log wandb: not installed: {to_install('wandb')}")


def open_board(name: str, run: Path) -> TensorBoard | Wandb | None:
    """Open "tensorboard" or "wandb" for a run folder; None if TensorBoard is not installed.

    Raises:
        Exception: any error of the board; its ``write`` and ``close`` may raise as well.
    """
    if name == "wandb":
        return Wandb(run)
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return TensorBoard(SummaryWriter(str(run / "tensorboard")))


def _scalars(event: str, values: Mapping[str, object]) -> dict[str, float]:
    """Numbers of a log line, named ``event/name``."""
    return {
        f"{event}/{name}": value
        for name, value in values.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }


class TensorBoard:
    """TensorBoard files in ``RUN/tensorboard``."""

    def __init__(self, writer: Any) -> None:
        """Wrap a ``SummaryWriter``."""
        self.writer = writer

    def write(self, event: str, step: int, values: Mapping[str, object]) -> None:
        """Write the numbers of a log line."""
        for name, value in _scalars(event, values).items():
            self.writer.add_scalar(name, value, step)

    def picture(self, name: str, step: int, pixels: np.ndarray) -> None:
        """Write a picture ``[H, W, 3]`` uint8."""
        self.writer.add_image(name, pixels, step, dataformats="HWC")

    def close(self) -> None:
        """Close the files."""
        self.writer.close()


class _WandbFile(msgspec.Struct):
    """``RUN/wandb.json``: the id with which a resumed run continues."""

    id: Annotated[str, msgspec.Meta(pattern="^[0-9a-z]{1,64}$")]


class Wandb:
    """Run of Weights & Biases, with its files in ``RUN/wandb``.

    Server, project and online mode follow from wandb's own settings, such as the environment
    variables ``WANDB_PROJECT`` and ``WANDB_MODE``.
    """

    def __init__(self, run: Path) -> None:
        """Begin a run, or resume the one of ``RUN/wandb.json``."""
        import wandb  # pyright: ignore[reportMissingImports]: optional

        path = run / "wandb.json"
        try:
            number = read_document(path, _WandbFile).id
        except UserError:  # missing or damaged
            number = secrets.token_hex(8)
            write_json(path, {"id": number})
        # wandb's capture of the output would break the progress bar; its login prompt times out.
        quiet = wandb.Settings(console="off", silent=True, save_code=False, login_timeout=30)
        about = {"dir": str(run), "id": number, "name": run.resolve().name}
        self.run = wandb.init(**about, resume="allow", settings=quiet)
        # wandb's own step counter cannot go back to the step of a checkpoint.
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")
        self._code = 1  # exit code of a run that does not reach its end

    def write(self, event: str, step: int, values: Mapping[str, object]) -> None:
        """Send the numbers of a log line, and at the start the configuration."""
        if event == "start":
            self.run.config.update(values.get("config", {}), allow_val_change=True)
        if event == "end":
            self._code = values.get("code", 1)
        self.run.log({"step": step, **_scalars(event, values)})

    def picture(self, name: str, step: int, pixels: np.ndarray) -> None:
        """Send a picture ``[H, W, 3]`` uint8."""
        import wandb  # pyright: ignore[reportMissingImports]: optional

        self.run.log({"step": step, name: wandb.Image(pixels)})

    def close(self) -> None:
        """Finish the run; otherwise wandb marks it as crashed."""
        self.run.finish(exit_code=self._code)
