"""Calls of the extension module, under causal-conv1d's path."""

from .. import extensions

causal_conv1d_fwd_function = extensions.conv_fwd
causal_conv1d_bwd_function = extensions.conv_bwd
causal_conv1d_update_function = extensions.conv_update
