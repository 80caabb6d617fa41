// Shaders. A Gaussian is two texels of 4 words, defined in pack.py.

// Gaussians per instance. Software renderers have a high cost per instance, so that
// an instance per Gaussian would be fifty times slower.
const BATCH = 256;

const SHADER_HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
`;

const SHADER_GAUSSIAN = `${SHADER_HEAD}
uniform usampler2D records, harmonics;
uniform mat3 view;
uniform vec3 eye;
uniform vec2 size;
uniform float focal, dot_size;
uniform int degree;

uvec4 near_words, far_words;
void fetch(uint index) {
  ivec2 p = ivec2(int(index & 1023u) * 2, int(index >> 10));
  near_words = texelFetch(records, p, 0);
  far_words = texelFetch(records, p + ivec2(1, 0), 0);
}
vec4 look() { return vec4(unpackHalf2x16(near_words.w), unpackHalf2x16(far_words.x)); }

// Coefficient k of degree 1 and up: three of the half floats of the Gaussian's row of texels.
uint base_texel;
float coefficient(int n) {
  uint t = base_texel + uint(n >> 3);
  uvec4 texel = texelFetch(harmonics, ivec2(int(t & 2047u), int(t >> 11)), 0);
  vec2 pair = unpackHalf2x16(texel[(n >> 1) & 3]);
  return (n & 1) == 0 ? pair.x : pair.y;
}
vec3 coefficients(int k) {
  return vec3(coefficient(3 * k), coefficient(3 * k + 1), coefficient(3 * k + 2));
}
vec3 seen_from(uint index, vec3 d) {
  const uint texels[4] = uint[4](0u, 2u, 3u, 6u);
  base_texel = index * texels[degree];
  float c = 0.4886025119029199, x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = c * (z * coefficients(1) - y * coefficients(0) - x * coefficients(2));
  if (degree < 2) return sum;
  c = 1.0925484305920792;
  sum += c * (x * y * coefficients(3) - y * z * coefficients(4) - x * z * coefficients(6))
    + 0.31539156525252005 * (2.0 * zz - xx - yy) * coefficients(5)
    + 0.5462742152960396 * (xx - yy) * coefficients(7);
  if (degree < 3) return sum;
  return sum - 0.5900435899266435 * y * (3.0 * xx - yy) * coefficients(8)
    + 2.890611442640554 * x * y * z * coefficients(9)
    - 0.4570457994644658 * y * (4.0 * zz - xx - yy) * coefficients(10)
    + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficients(11)
    - 0.4570457994644658 * x * (4.0 * zz - xx - yy) * coefficients(12)
    + 1.445305721320277 * z * (xx - yy) * coefficients(13)
    - 0.5900435899266435 * x * (xx - 3.0 * yy) * coefficients(14);
}
vec3 colour_of(uint index, vec3 mean, vec3 rgb) {
  return max(vec3(0.0), degree == 0 ? rgb : rgb + seen_from(index, normalize(mean - eye)));
}
`;

// Each Gaussian is a rectangle along the axes of its ellipse, up to an alpha of 1/255.
const SPLAT_VERTEX = `${SHADER_GAUSSIAN}
uniform usampler2D order;
uniform uint first, last;
uniform bool antialiased;
out vec2 at;
out vec4 colour;
void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  uint place = first + uint(gl_InstanceID) * ${BATCH}u + uint(gl_VertexID >> 2);
  if (place >= last) return;
  uint index = texelFetch(order, ivec2(int(place & 2047u), int(place >> 11)), 0).x;
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  fetch(index);
  vec3 mean = uintBitsToFloat(near_words.xyz), m = view * (mean - eye);
  vec4 opacity_rgb = look();
  if (m.z < 0.01 || opacity_rgb.x < 1.0 / 255.0) return;
  vec3 scales = vec3(unpackHalf2x16(far_words.y), unpackHalf2x16(far_words.z).x);
  vec3 p = vec3(unpackSnorm2x16(far_words.z).y, unpackSnorm2x16(far_words.w));
  float k = 2.0 / (1.0 + dot(p, p)), w = k - 1.0, f = focal / m.z;
  vec3 q = k * p;
  // For centres far outside the image, the Jacobian is clamped to the margin.
  vec2 slope = clamp(m.xy / m.z, -0.65 * size / focal, 0.65 * size / focal);
  vec3 u = vec3(f, 0.0, -f * slope.x) * view, v = vec3(0.0, f, -f * slope.y) * view;
  // Into the Gaussian's own axes: the inverse rotation.
  u = (u + 2.0 * cross(q, cross(q, u) - w * u)) * scales;
  v = (v + 2.0 * cross(q, cross(q, v) - w * v)) * scales;
  float xx = dot(u, u) + 0.3, xy = dot(u, v), yy = dot(v, v) + 0.3;
  if (antialiased) { // the light that the wider ellipse would add
    opacity_rgb.x *= sqrt(max(0.0, ((xx - 0.3) * (yy - 0.3) - xy * xy) / (xx * yy - xy * xy)));
    if (opacity_rgb.x < 1.0 / 255.0) return;
  }
  float mid = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-6 * mid ? normalize(vec2(xy, 0.5 * (yy - xx) + spread))
    : (xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  at = corner * sqrt(2.0 * log(255.0 * opacity_rgb.x));
  vec2 shift = at.x * sqrt(mid + spread) * axis
    + at.y * sqrt(max(mid - spread, 0.3)) * vec2(-axis.y, axis.x);
  vec2 pixel = f * m.xy + shift;
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, 0.0, 1.0);
  colour = vec4(colour_of(index, mean, opacity_rgb.yzw), opacity_rgb.x);
}`;

const SPLAT_FRAGMENT = `${SHADER_HEAD}
in vec2 at;
in vec4 colour;
out vec4 result;
void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

const POINT_VERTEX = `${SHADER_GAUSSIAN}
out vec4 colour;
void main() {
  uint index = uint(gl_VertexID);
  fetch(index);
  vec3 mean = uintBitsToFloat(near_words.xyz), m = view * (mean - eye);
  vec4 opacity_rgb = look();
  gl_PointSize = dot_size;
  float depth = (m.z - 0.01) / (m.z + 0.5);
  gl_Position = opacity_rgb.x < 0.02 || m.z < 0.01 ? vec4(2.0, 2.0, 2.0, 1.0)
    : vec4(2.0 * focal * m.xy / size / m.z * vec2(1.0, -1.0), 2.0 * depth - 1.0, 1.0);
  colour = vec4(colour_of(index, mean, opacity_rgb.yzw), 1.0);
}`;

const POINT_FRAGMENT = `${SHADER_HEAD}
in vec4 colour;
out vec4 result;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  result = colour;
}`;

const MESH_VERTEX = `${SHADER_HEAD}
uniform mat3 view;
uniform vec3 eye;
uniform vec2 size;
uniform float focal;
in vec3 vertex, normal;
in vec4 paint;
out vec3 facing, place;
out vec4 colour;
void main() {
  vec3 m = view * (vertex - eye);
  facing = view * normal;
  place = m;
  colour = paint;
  vec2 flat_xy = 2.0 * focal * m.xy / size * vec2(1.0, -1.0);
  gl_Position = vec4(flat_xy, m.z - 0.02, m.z);
}`;

// The light is beside the camera; both sides are lit, because a scanned mesh may be open.
const MESH_FRAGMENT = `${SHADER_HEAD}
in vec3 facing, place;
in vec4 colour;
out vec4 result;
void main() {
  vec3 n = dot(facing, facing) > 1e-20 ? normalize(facing) : vec3(0.0, 0.0, -1.0);
  if (dot(n, place) > 0.0) n = -n;
  float light = 0.62 + 0.3 * max(0.0, dot(n, normalize(vec3(-0.45, -0.75, -0.6))))
    + 0.16 * max(0.0, -n.z);
  result = vec4(min(vec3(1.0), colour.rgb * light), 1.0);
}`;

// The image onto the canvas, pixel by pixel. (Software browsers sometimes show black after a
// blitFramebuffer onto a canvas.)
const PRESENT_VERTEX = `${SHADER_HEAD}
void main() {
  gl_Position = vec4(vec2(ivec2(gl_VertexID & 1, gl_VertexID >> 1) * 4 - 1), 0.0, 1.0);
}`;

const PRESENT_FRAGMENT = `${SHADER_HEAD}
uniform sampler2D image;
out vec4 result;
void main() {
  result = texelFetch(image, ivec2(gl_FragCoord.xy), 0);
}`;
