"""``layer_norm`` under the path of mamba-ssm 1."""

from .layer_norm import *  # noqa: F403
