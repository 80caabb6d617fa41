// The real spherical harmonics Y_k, in the order and signs of 3DGS, as polynomials of the
// direction x, y, z, and their slopes, for both devices: F is a float, or lanes of floats.
namespace gamba::harmonics {

// Factors sqrt((2l + 1)/(4π) (l - m)!/(l + m)!) of degree l, times those of the polynomials.
constexpr float A0 = 0.28209479177387814f, A1 = 0.4886025119029199f;
constexpr float A2 = 1.0925484305920792f, B2 = 0.31539156525252005f, C2 = 0.5462742152960396f;
constexpr float A3 = 0.5900435899266435f, B3 = 2.890611442640554f, C3 = 0.4570457994644658f;
constexpr float D3 = 0.3731763325901154f, E3 = 1.445305721320277f;
constexpr float A4 = 2.5033429417967046f, B4 = 1.7701307697799304f, C4 = 0.9461746957575601f;
constexpr float D4 = 0.6690465435572892f, E4 = 0.10578554691520431f, F4 = 0.47308734787878004f;
constexpr float G4 = 0.6258357354491761f;

// Fills Y[k], k < (DEGREE + 1)².
template<int DEGREE, class F>
static inline void basis(F x, F y, F z, F* Y) {
    const F xx = x * x, yy = y * y, zz = z * z;
    Y[0] = F{} + A0;
    if constexpr (DEGREE >= 1) {
        Y[1] = -A1 * y;
        Y[2] = A1 * z;
        Y[3] = -A1 * x;
    }
    if constexpr (DEGREE >= 2) {
        Y[4] = A2 * x * y;
        Y[5] = -A2 * y * z;
        Y[6] = B2 * (2.0f * zz - xx - yy);
        Y[7] = -A2 * x * z;
        Y[8] = C2 * (xx - yy);
    }
    if constexpr (DEGREE >= 3) {
        Y[9] = -A3 * y * (3.0f * xx - yy);
        Y[10] = B3 * x * y * z;
        Y[11] = -C3 * y * (4.0f * zz - xx - yy);
        Y[12] = D3 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
        Y[13] = -C3 * x * (4.0f * zz - xx - yy);
        Y[14] = E3 * z * (xx - yy);
        Y[15] = -A3 * x * (xx - 3.0f * yy);
    }
    if constexpr (DEGREE >= 4) {
        const F p = 3.0f * xx - yy, q = xx - 3.0f * yy, seven = 7.0f * zz;
        Y[16] = A4 * x * y * (xx - yy);
        Y[17] = -B4 * y * z * p;
        Y[18] = C4 * x * y * (seven - 1.0f);
        Y[19] = -D4 * y * z * (seven - 3.0f);
        Y[20] = E4 * (35.0f * zz * zz - 30.0f * zz + 3.0f);
        Y[21] = -D4 * x * z * (seven - 3.0f);
        Y[22] = F4 * (xx - yy) * (seven - 1.0f);
        Y[23] = -B4 * x * z * q;
        Y[24] = G4 * (xx * q - yy * p);
    }
}

// Adds the gradient of Σ_k s[k] Y[k] by x, y, z to v_x, v_y, v_z.
template<int DEGREE, class F>
static inline void slopes(F x, F y, F z, const F* s, F& v_x, F& v_y, F& v_z) {
    const F xx = x * x, yy = y * y, zz = z * z;
    if constexpr (DEGREE >= 1) {
        v_x -= A1 * s[3];
        v_y -= A1 * s[1];
        v_z += A1 * s[2];
    }
    if constexpr (DEGREE >= 2) {
        v_x += A2 * (y * s[4] - z * s[7]) + 2.0f * x * (C2 * s[8] - B2 * s[6]);
        v_y += A2 * (x * s[4] - z * s[5]) - 2.0f * y * (C2 * s[8] + B2 * s[6]);
        v_z += 4.0f * B2 * z * s[6] - A2 * (y * s[5] + x * s[7]);
    }
    if constexpr (DEGREE >= 3) {
        const F xy = x * y, xz = x * z, yz = y * z;
        v_x += B3 * yz * s[10] + 2.0f * (C3 * xy * s[11] + E3 * xz * s[14] - 3.0f * D3 * xz * s[12])
            - 3.0f * A3 * (2.0f * xy * s[9] + (xx - yy) * s[15])
            - C3 * (4.0f * zz - 3.0f * xx - yy) * s[13];
        v_y += B3 * xz * s[10] + 2.0f * (C3 * xy * s[13] - E3 * yz * s[14] - 3.0f * D3 * yz * s[12])
            + 3.0f * A3 * (2.0f * xy * s[15] - (xx - yy) * s[9])
            - C3 * (4.0f * zz - xx - 3.0f * yy) * s[11];
        v_z += B3 * xy * s[10] - 8.0f * C3 * (yz * s[11] + xz * s[13])
            + 3.0f * D3 * (2.0f * zz - xx - yy) * s[12] + E3 * (xx - yy) * s[14];
    }
    if constexpr (DEGREE >= 4) {
        const F p = 3.0f * xx - yy, q = xx - 3.0f * yy, seven = 7.0f * zz;
        const F xyz = x * y * z, r = xx - yy;
        v_x += A4 * y * p * s[16] - 3.0f * B4 * (2.0f * xyz * s[17] + z * r * s[23])
            + (seven - 1.0f) * (C4 * y * s[18] + 2.0f * F4 * x * s[22])
            - D4 * z * (seven - 3.0f) * s[21] + 4.0f * G4 * x * q * s[24];
        v_y += A4 * x * q * s[16] + 3.0f * B4 * (2.0f * xyz * s[23] - z * r * s[17])
            + (seven - 1.0f) * (C4 * x * s[18] - 2.0f * F4 * y * s[22])
            - D4 * z * (seven - 3.0f) * s[19] - 4.0f * G4 * y * p * s[24];
        v_z += 14.0f * (C4 * xyz * s[18] + F4 * z * r * s[22])
            - B4 * (y * p * s[17] + x * q * s[23])
            - 3.0f * D4 * (seven - 1.0f) * (y * s[19] + x * s[21])
            + 20.0f * E4 * z * (seven - 3.0f) * s[20];
    }
}

}  // namespace gamba::harmonics
