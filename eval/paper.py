"""The figures of the paper's Table 1, to stand beside a table of ours."""

from __future__ import annotations

# Gamba (Shen et al. 2024), Table 1: PSNR, SSIM, LPIPS, Chamfer distance, Volume IoU, seconds.
TABLE_1: dict[str, tuple[float | None, ...]] = {
    "One-2-3-45": (14.93, 0.72, 0.28, 0.0683, 0.3485, 40),
    "Point-E": (None, None, None, 0.0515, 0.2643, 78),
    "Shap-E": (None, None, None, 0.0579, 0.3228, 27),
    "Zero-1-to-3": (18.28, 0.76, 0.19, 0.0385, 0.3786, 1800),
    "DreamGaussian": (21.65, 0.82, 0.14, 0.0341, 0.3615, 70),
    "LRM": (21.35, 0.82, 0.15, 0.0325, 0.3872, 0.5),
    "TGS": (22.68, 0.85, 0.12, 0.0257, 0.4121, 0.2),
    "Gamba": (24.74, 0.91, 0.08, 0.0232, 0.4289, 0.05),
}
CAVEAT = (
    "The paper's own figures, of other objects and by a protocol that it does not write "
    "down, on an A100. They cannot be compared with the rows above."
)
