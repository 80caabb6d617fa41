"""Files of a model in a folder, or in a repository of the Hugging Face Hub."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import torch

from ....untrusted.documents import read_document


def _file(model_name: str, name: str) -> Path:
    """Return the path of a file; outside a folder, huggingface_hub finds or downloads it."""
    path = Path(model_name)
    if path.is_dir():
        return path / name
    return Path(importlib.import_module("huggingface_hub").hf_hub_download(model_name, name))


def load_config_hf(model_name: str) -> Any:
    """Read ``config.json``."""
    return read_document(_file(model_name, "config.json"), dict[str, Any])


def load_state_dict_hf(model_name: str, device=None, dtype: torch.dtype | None = None) -> dict:
    """Read the tensors of ``pytorch_model.bin``, and nothing else."""
    file = _file(model_name, "pytorch_model.bin")
    state = torch.load(file, map_location=device, weights_only=True, mmap=True)
    return {name: value.to(dtype) for name, value in state.items()}
