// needs: cuda.py: F, x, y, z, Y; cpu.py: DEGREE
// gives: xx, yy, zz
// Fills Y[k], k < (DEGREE + 1)^2, at the direction x, y, z; F is a float, or lanes of floats.
const F xx = x * x, yy = y * y, zz = z * z;

Y[0] = F{} + 0.28209479177387814f;
if constexpr (DEGREE >= 1) {
    const float a = 0.4886025119029199f;
    Y[1] = -a * y;
    Y[2] = a * z;
    Y[3] = -a * x;
}

if constexpr (DEGREE >= 2) {
    const float a = 1.0925484305920792f, b = 0.31539156525252005f, c = 0.5462742152960396f;

    Y[4] = a * x * y;
    Y[5] = -a * y * z;
    Y[6] = b * (2.0f * zz - xx - yy);
    Y[7] = -a * x * z;
    Y[8] = c * (xx - yy);
}

if constexpr (DEGREE >= 3) {

    const float a = 0.5900435899266435f, b = 2.890611442640554f, c = 0.4570457994644658f;
    const float d = 0.3731763325901154f, e = 1.445305721320277f;

    Y[9] = -a * y * (3.0f * xx - yy);
    Y[10] = b * x * y * z;
    Y[11] = -c * y * (4.0f * zz - xx - yy);
    Y[12] = d * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
    Y[13] = -c * x * (4.0f * zz - xx - yy);
    Y[14] = e * z * (xx - yy);
    Y[15] = -a * x * (xx - 3.0f * yy);
}

if constexpr (DEGREE >= 4) {

    const float a = 2.5033429417967046f, b = 1.7701307697799304f, c = 0.9461746957575601f;
    const float d = 0.6690465435572892f, e = 0.10578554691520431f, f = 0.47308734787878004f;
    const float g = 0.6258357354491761f;
    const F p = 3.0f * xx - yy, q = xx - 3.0f * yy, seven = 7.0f * zz;

    Y[16] = a * x * y * (xx - yy);
    Y[17] = -b * y * z * p;
    Y[18] = c * x * y * (seven - 1.0f);
    Y[19] = -d * y * z * (seven - 3.0f);
    Y[20] = e * (35.0f * zz * zz - 30.0f * zz + 3.0f);
    Y[21] = -d * x * z * (seven - 3.0f);
    Y[22] = f * (xx - yy) * (seven - 1.0f);
    Y[23] = -b * x * z * q;
    Y[24] = g * (xx * q - yy * p);
}
