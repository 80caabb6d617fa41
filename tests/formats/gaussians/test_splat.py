import numpy as np
import pytest
import torch
from helpers.gaussians import some

from gamba_warp.formats.gaussians.splat import save_splat


def unit(quats):
    return quats / quats.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("rotated", [True, False])
def test_splat_records(tmp_path, rotated):
    gaussians = some(rotated=rotated)
    save_splat(tmp_path / "a.splat", gaussians)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 37 * 32
    numbers = np.frombuffer(data, "<f4").reshape(37, 8)
    small = np.frombuffer(data, "u1").reshape(37, 32)[:, 24:]
    order = (gaussians.scales.prod(1) * gaussians.opacities).argsort(descending=True)
    sorted_ = gaussians.select(order)
    np.testing.assert_array_equal(numbers[:, :3], sorted_.means)
    np.testing.assert_array_equal(numbers[:, 3:6], sorted_.scales)
    # 8 bits: half a step
    rgba = torch.cat([sorted_.colors, sorted_.opacities[:, None]], 1).numpy()
    np.testing.assert_allclose(small[:, :4] / 255, rgba, atol=0.501 / 255)
    quats = unit(sorted_.quats) if rotated else torch.eye(4)[:1].expand(37, 4)
    # the largest byte stands for 127/128, so 1 is off by a whole step
    np.testing.assert_allclose((small[:, 4:].astype(float) - 128) / 128, quats, atol=1.001 / 128)
