"""The limits of ``gamba stress``: cases that failed once, and what rounding is said to do."""

import json
from pathlib import Path

import pytest
import torch
from ops.stress import model_case as model

from gamba_warp.kernels.cases import conv, raster, scan
from gamba_warp.kernels.cases.random_case import RandomCase, run_case
from gamba_warp.kernels.rasterize.reference import rasterization_reference

CPU = torch.device("cpu")
OPS = {module.OP.name: module.OP for module in (conv, scan, raster, model)}
# Cases that failed once.
CORPUS = json.loads(Path(__file__).with_name("corpus.json").read_text())


@pytest.mark.parametrize("name", CORPUS)
def test_cases_that_failed_once_pass(name):
    case = RandomCase(**CORPUS[name])
    outcome = run_case(OPS[case.op], case, CPU)
    assert outcome.comparisons and outcome.failure() is None, outcome.failure()


@pytest.mark.parametrize("name", [name for name in CORPUS if name.startswith("raster")])
def test_examples_of_the_rasterizer_pass_on_cuda(from_ptx, name):
    from_ptx()
    test_cases_that_failed_once_pass(name)


def test_a_gradient_that_is_not_finite_beside_poison_is_a_failure(monkeypatch):
    """Only numbers beyond the dtype's range may be infinite, and only those of the right row."""
    case = RandomCase(**CORPUS["raster-gradient-beyond-float16"])
    right = raster.gradients_of
    for row in range(9):

        def leaking(results, leaves, cotangents, row=row):
            grads = right(results, leaves, cotangents)
            if len(leaves["means"]) == 9:  # with the Gaussian that is not finite
                grads["scales"][row, 1] = torch.inf
            return grads

        monkeypatch.setattr(raster, "gradients_of", leaking)
        failure = run_case(raster.OP, case, CPU).failure()
        assert failure and "gradient of scales not finite" in failure["name"], row


@pytest.mark.parametrize("kind", ["needles", "all sizes", "huge on screen"])
def test_the_reference_in_float32_is_far_off(monkeypatch, kind):
    """So limits come from a formula in the kernels' order: README.md, "Formulas of their own"."""

    def by_reference(render_mode, rasterize_mode, sh_degree, skip, radius_clip, **x):
        colors, _, alphas = rasterization_reference(**x)
        return colors, alphas, None

    options = dict(num=30, width=17, height=13, channels=3, use_quats=True)
    case = RandomCase("raster", kind, 1, raster.OP.plain | options)
    assert raster.evaluate(case, CPU).worst.ratio < 0.5
    monkeypatch.setattr(raster, "rasterization", by_reference)
    assert raster.evaluate(case, CPU).worst.ratio > 100
