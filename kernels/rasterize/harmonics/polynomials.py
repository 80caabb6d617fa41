"""The harmonics and their gradient as C++ text, the same for lanes on a CPU and threads on CUDA.

README.md §6 of the rasterizer holds them. In the text ``F`` is a float, or lanes of floats;
``x, y, z`` is the direction, ``Y[k]`` and ``s[k]`` are those of the README.
"""

MOST_CHANNELS = 64  # of the kernels: on a CPU the rows of coefficients lie on a thread's stack
SHORTEST = 1e-12  # what is shorter is divided by this in place of its length

_SQUARES = "const F xx = x * x, yy = y * y, zz = z * z;\n"

# By degree: the constants, the values, and what the degree adds to v_x, v_y, v_z.
_TERMS = (
    ("", "Y[0] = F{} + 0.28209479177387814f;", ""),
    (
        "const float a = 0.4886025119029199f;",
        "Y[1] = -a * y; Y[2] = a * z; Y[3] = -a * x;",
        "v_x -= a * s[3]; v_y -= a * s[1]; v_z += a * s[2];",
    ),
    (
        "const float a = 1.0925484305920792f, b = 0.31539156525252005f, c = 0.5462742152960396f;",
        """
        Y[4] = a * x * y;
        Y[5] = -a * y * z;
        Y[6] = b * (2.0f * zz - xx - yy);
        Y[7] = -a * x * z;
        Y[8] = c * (xx - yy);
        """,
        """
        v_x += a * (y * s[4] - z * s[7]) + 2.0f * x * (c * s[8] - b * s[6]);
        v_y += a * (x * s[4] - z * s[5]) - 2.0f * y * (c * s[8] + b * s[6]);
        v_z += 4.0f * b * z * s[6] - a * (y * s[5] + x * s[7]);
        """,
    ),
    (
        """
        const float a = 0.5900435899266435f, b = 2.890611442640554f, c = 0.4570457994644658f;
        const float d = 0.3731763325901154f, e = 1.445305721320277f;
        """,
        """
        Y[9] = -a * y * (3.0f * xx - yy);
        Y[10] = b * x * y * z;
        Y[11] = -c * y * (4.0f * zz - xx - yy);
        Y[12] = d * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
        Y[13] = -c * x * (4.0f * zz - xx - yy);
        Y[14] = e * z * (xx - yy);
        Y[15] = -a * x * (xx - 3.0f * yy);
        """,
        """
        const F xy = x * y, xz = x * z, yz = y * z;
        v_x += b * yz * s[10] + 2.0f * (c * xy * s[11] + e * xz * s[14] - 3.0f * d * xz * s[12])
            - 3.0f * a * (2.0f * xy * s[9] + (xx - yy) * s[15])
            - c * (4.0f * zz - 3.0f * xx - yy) * s[13];
        v_y += b * xz * s[10] + 2.0f * (c * xy * s[13] - e * yz * s[14] - 3.0f * d * yz * s[12])
            + 3.0f * a * (2.0f * xy * s[15] - (xx - yy) * s[9])
            - c * (4.0f * zz - xx - 3.0f * yy) * s[11];
        v_z += b * xy * s[10] - 8.0f * c * (yz * s[11] + xz * s[13])
            + 3.0f * d * (2.0f * zz - xx - yy) * s[12] + e * (xx - yy) * s[14];
        """,
    ),
    (
        """
        const float a = 2.5033429417967046f, b = 1.7701307697799304f, c = 0.9461746957575601f;
        const float d = 0.6690465435572892f, e = 0.10578554691520431f, f = 0.47308734787878004f;
        const float g = 0.6258357354491761f;
        const F p = 3.0f * xx - yy, q = xx - 3.0f * yy, seven = 7.0f * zz;
        """,
        """
        Y[16] = a * x * y * (xx - yy);
        Y[17] = -b * y * z * p;
        Y[18] = c * x * y * (seven - 1.0f);
        Y[19] = -d * y * z * (seven - 3.0f);
        Y[20] = e * (35.0f * zz * zz - 30.0f * zz + 3.0f);
        Y[21] = -d * x * z * (seven - 3.0f);
        Y[22] = f * (xx - yy) * (seven - 1.0f);
        Y[23] = -b * x * z * q;
        Y[24] = g * (xx * q - yy * p);
        """,
        """
        const F xyz = x * y * z, r = xx - yy;
        v_x += a * y * p * s[16] - 3.0f * b * (2.0f * xyz * s[17] + z * r * s[23])
            + (seven - 1.0f) * (c * y * s[18] + 2.0f * f * x * s[22])
            - d * z * (seven - 3.0f) * s[21] + 4.0f * g * x * q * s[24];
        v_y += a * x * q * s[16] + 3.0f * b * (2.0f * xyz * s[23] - z * r * s[17])
            + (seven - 1.0f) * (c * x * s[18] - 2.0f * f * y * s[22])
            - d * z * (seven - 3.0f) * s[19] - 4.0f * g * y * p * s[24];
        v_z += 14.0f * (c * xyz * s[18] + f * z * r * s[22]) - b * (y * p * s[17] + x * q * s[23])
            - 3.0f * d * (seven - 1.0f) * (y * s[19] + x * s[21])
            + 20.0f * e * z * (seven - 3.0f) * s[20];
        """,
    ),
)


def basis_text(degree: int) -> str:
    """C++ that fills ``Y[k]``, k < (degree + 1)²."""
    return _SQUARES + "".join(f"{{ {c} {values} }}\n" for c, values, _ in _TERMS[: degree + 1])


def slopes_text(degree: int) -> str:
    """C++ that adds the gradient of ``Σ_k s[k] Y_k`` by ``x, y, z`` to ``v_x, v_y, v_z``."""
    return _SQUARES + "".join(f"{{ {c} {slopes} }}\n" for c, _, slopes in _TERMS[: degree + 1])
