"""mamba-ssm's public names for Mamba-1 over our kernels, on CUDA and on plain CPUs."""

from ..absent import complete
from ..causal_conv1d import causal_conv1d_fn, causal_conv1d_update
from .modules.mamba_simple import Mamba
from .ops.selective_scan_interface import (
    mamba_inner_fn,
    mamba_inner_ref,
    selective_scan_fn,
    selective_scan_ref,
)
from .ops.triton.selective_state_update import selective_state_update, selective_state_update_ref
from .utils.generation import InferenceParams

__all__ = [
    "InferenceParams",
    "Mamba",
    "causal_conv1d_fn",
    "causal_conv1d_update",
    "mamba_inner_fn",
    "mamba_inner_ref",
    "selective_scan_fn",
    "selective_scan_ref",
    "selective_state_update",
    "selective_state_update_ref",
]

ABSENT = complete(
    __name__,
    "mamba-ssm",
    "only its Mamba-1 is",
    {
        "": "Mamba2 Mamba3 MambaLMHeadModel",
        "distributed.distributed_utils": "AllGatherFunc AllReduceFunc ReduceScatterFunc all_gather "
        "all_gather_raw all_reduce all_reduce_raw allreduce_sequence_parallel_grad "
        "get_dim_for_local_rank reduce_scatter reduce_scatter_raw sync_shared_params",
        "distributed.tensor_parallel": "ColumnParallelEmbedding ColumnParallelLinear "
        "ParallelEmbeddings ParallelLinearFunc RowParallelLinear VocabParallelEmbedding "
        "parallel_linear_func",
        "models.config_mamba": "MambaConfig",
        "models.mixer_seq_simple": "MambaLMHeadModel MixerModel",
        "modules.mamba2": "Mamba2",
        "modules.mamba2_simple": "Mamba2Simple",
        "modules.mamba3": "Mamba3",
        "modules.mha": "MHA",
        "modules.mlp": "GatedMLP",
        "modules.ssd_minimal": "segsum segsum_unstable ssd_minimal_discrete",
        "ops.cute.mamba3.mamba3_step_fn": "mamba3_step_fn",
        "ops.selective_scan_interface": "MambaInnerFn SelectiveScanFn rms_norm_forward",
        "ops.tilelang.mamba3.mamba3_mimo": "mamba3_mimo",
        "ops.triton.k_activations": "SwiGLU swiglu",
        "ops.triton.layer_norm": "LayerNormFn LayerNormLinearFn layer_norm_linear_fn",
        "ops.triton.layernorm": "LayerNormFn",
        "ops.triton.layernorm_gated": "LayerNorm LayerNormFn RMSNorm layernorm_fn rms_norm_ref "
        "rmsnorm_fn",
        "ops.triton.mamba3.mamba3_mimo_rotary_step": "apply_rotary_qk_inference_fwd",
        "ops.triton.mamba3.mamba3_siso_combined": "mamba3_siso_combined",
        "ops.triton.ssd_chunk_scan": "ChunkScanFn chunk_scan chunk_scan_ref",
        "ops.triton.ssd_chunk_state": "ChunkStateFn chunk_state chunk_state_ref chunk_state_varlen",
        "ops.triton.ssd_combined": "MambaChunkScanCombinedFn MambaSplitConv1dScanCombinedFn "
        "mamba_chunk_scan mamba_chunk_scan_combined mamba_conv1d_scan_ref "
        "mamba_split_conv1d_scan_combined mamba_split_conv1d_scan_ref selective_scan_bwd "
        "ssd_chunk_scan_combined_ref ssd_selective_scan",
        "ops.triton.ssd_state_passing": "StatePassingFn state_passing state_passing_ref",
        "utils.determinism": "set_deterministic_mode use_deterministic_mode",
        "utils.generation": "DecodingCGCache GenerationMixin capture_graph decode "
        "modify_logit_for_repetition_penalty modify_logits_for_min_p_filtering "
        "modify_logits_for_top_k_filtering modify_logits_for_top_p_filtering sample "
        "update_graph_cache",
        "utils.hf": "load_config_hf load_state_dict_hf",
        "utils.torch": "custom_amp_decorator custom_bwd custom_fwd",
    },
)
