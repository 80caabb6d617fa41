// needs: cuda.py: F, x, y, z, v_x, v_y, v_z; cpu.py: DEGREE, s
// gives: xx, yy, zz
// Adds the gradient of the sum of s[k] Y[k] by x, y, z to v_x, v_y, v_z.
const F xx = x * x, yy = y * y, zz = z * z;
if constexpr (DEGREE >= 1) {
    const float a = 0.4886025119029199f;
    v_x -= a * s[3];
    v_y -= a * s[1];
    v_z += a * s[2];
}

if constexpr (DEGREE >= 2) {
    const float a = 1.0925484305920792f, b = 0.31539156525252005f, c = 0.5462742152960396f;

    v_x += a * (y * s[4] - z * s[7]) + 2.0f * x * (c * s[8] - b * s[6]);
    v_y += a * (x * s[4] - z * s[5]) - 2.0f * y * (c * s[8] + b * s[6]);
    v_z += 4.0f * b * z * s[6] - a * (y * s[5] + x * s[7]);
}

if constexpr (DEGREE >= 3) {

    const float a = 0.5900435899266435f, b = 2.890611442640554f, c = 0.4570457994644658f;
    const float d = 0.3731763325901154f, e = 1.445305721320277f;

    const F xy = x * y, xz = x * z, yz = y * z;
    v_x += b * yz * s[10] + 2.0f * (c * xy * s[11] + e * xz * s[14] - 3.0f * d * xz * s[12])
        - 3.0f * a * (2.0f * xy * s[9] + (xx - yy) * s[15])
        - c * (4.0f * zz - 3.0f * xx - yy) * s[13];
    v_y += b * xz * s[10] + 2.0f * (c * xy * s[13] - e * yz * s[14] - 3.0f * d * yz * s[12])
        + 3.0f * a * (2.0f * xy * s[15] - (xx - yy) * s[9])
        - c * (4.0f * zz - xx - 3.0f * yy) * s[11];
    v_z += b * xy * s[10] - 8.0f * c * (yz * s[11] + xz * s[13])
        + 3.0f * d * (2.0f * zz - xx - yy) * s[12] + e * (xx - yy) * s[14];
}

if constexpr (DEGREE >= 4) {

    const float a = 2.5033429417967046f, b = 1.7701307697799304f, c = 0.9461746957575601f;
    const float d = 0.6690465435572892f, e = 0.10578554691520431f, f = 0.47308734787878004f;
    const float g = 0.6258357354491761f;
    const F p = 3.0f * xx - yy, q = xx - 3.0f * yy, seven = 7.0f * zz;

    const F xyz = x * y * z, r = xx - yy;
    v_x += a * y * p * s[16] - 3.0f * b * (2.0f * xyz * s[17] + z * r * s[23])
        + (seven - 1.0f) * (c * y * s[18] + 2.0f * f * x * s[22]) - d * z * (seven - 3.0f) * s[21]
        + 4.0f * g * x * q * s[24];
    v_y += a * x * q * s[16] + 3.0f * b * (2.0f * xyz * s[23] - z * r * s[17])
        + (seven - 1.0f) * (c * x * s[18] - 2.0f * f * y * s[22]) - d * z * (seven - 3.0f) * s[19]
        - 4.0f * g * y * p * s[24];
    v_z += 14.0f * (c * xyz * s[18] + f * z * r * s[22]) - b * (y * p * s[17] + x * q * s[23])
        - 3.0f * d * (seven - 1.0f) * (y * s[19] + x * s[21])
        + 20.0f * e * z * (seven - 3.0f) * s[20];
}
