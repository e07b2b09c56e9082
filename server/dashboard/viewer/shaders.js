// The shaders. A point is shaded where it stands: its visibility times the light's matrix. What is drawn is a disc as wide as
// points lie apart there.

/** The basis functions of so many bands, as engine/src/shade/sh.rs has them. */
function basisSource(bands) {
  const lines = [
    ["y[0] = 0.28209479;"],
    ["y[1] = 0.48860251 * d.y;", "y[2] = 0.48860251 * d.z;", "y[3] = 0.48860251 * d.x;"],
    ["float zz = d.z * d.z; float c2 = d.x * d.x - d.y * d.y; float s2 = 2.0 * d.x * d.y; float p21 = 1.09254843 * d.z;",
      "y[4] = 0.54627422 * s2; y[5] = p21 * d.y; y[6] = 0.31539157 * (3.0 * zz - 1.0); y[7] = p21 * d.x; y[8] = 0.54627422 * c2;"],
    ["float c3 = d.x * c2 - d.y * s2; float s3 = d.x * s2 + d.y * c2; float p31 = 0.45704580 * (5.0 * zz - 1.0); float p32 = 1.44530572 * d.z;",
      "y[9] = 0.59004359 * s3; y[10] = p32 * s2; y[11] = p31 * d.y; y[12] = 0.37317633 * d.z * (5.0 * zz - 3.0); y[13] = p31 * d.x; y[14] = p32 * c2; y[15] = 0.59004359 * c3;"],
    ["float c4 = d.x * c3 - d.y * s3; float s4 = d.x * s3 + d.y * c3; float p41 = 0.66904654 * d.z * (7.0 * zz - 3.0); float p42 = 0.47308735 * (7.0 * zz - 1.0); float p43 = 1.77013077 * d.z;",
      "y[16] = 0.62583574 * s4; y[17] = p43 * s3; y[18] = p42 * s2; y[19] = p41 * d.y; y[20] = 0.10578555 * ((35.0 * zz - 30.0) * zz + 3.0); y[21] = p41 * d.x; y[22] = p42 * c2; y[23] = p43 * c3; y[24] = 0.62583574 * c4;"],
    ["float c5 = d.x * c4 - d.y * s4; float s5 = d.x * s4 + d.y * c4; float p51 = 0.45294665 * ((21.0 * zz - 14.0) * zz + 1.0); float p52 = 2.39676839 * d.z * (3.0 * zz - 1.0); float p53 = 0.48923830 * (9.0 * zz - 1.0); float p54 = 2.07566231 * d.z;",
      "y[25] = 0.65638206 * s5; y[26] = p54 * s4; y[27] = p53 * s3; y[28] = p52 * s2; y[29] = p51 * d.y; y[30] = 0.11695032 * d.z * ((63.0 * zz - 70.0) * zz + 15.0); y[31] = p51 * d.x; y[32] = p52 * c2; y[33] = p53 * c3; y[34] = p54 * c4; y[35] = 0.65638206 * c5;"],
  ];
  return lines.slice(0, bands).flat().join("\n  ");
}

/** Attributes that hold the coefficients: four in each, the last with what is left. */
export const coefficientSlots = (count) => Array.from({ length: Math.ceil(count / 4) }, (_, at) => Math.min(4, count - 4 * at));

/** The vertex shader for so many bands, with the error of the coefficients where points have one. */
export function pointVertex(bands, hasError) {
  const count = bands * bands;
  const slots = coefficientSlots(count);
  const swizzle = ["x", "y", "z", "w"];
  const unpack = slots.flatMap((size, slot) => Array.from({ length: size }, (_, at) => `v[${4 * slot + at}] = a_sh${slot}.${swizzle[at]};`)).join(" ");
  return `#version 300 es
precision highp float;
precision highp int;
layout(location = 0) in vec3 a_place;
layout(location = 1) in ivec2 a_normal;
layout(location = 2) in vec4 a_albedo;
${slots.map((size, slot) => `layout(location = ${3 + slot}) in vec4 a_sh${slot};`).join("\n")}
${hasError ? `layout(location = ${3 + slots.length}) in float a_error;` : "const float a_error = 0.0;"}
uniform mat4 u_clip;
uniform vec3 u_corner;
uniform float u_edge;
uniform float u_spacing[8];
uniform float u_pixels;
uniform float u_exposure;
uniform int u_show;
uniform int u_rows;
uniform float u_open;
uniform bool u_sphere;
uniform highp sampler2D u_matrix;
uniform int u_node;
out vec3 v_color;
flat out ivec2 v_id;

vec3 normalOf(ivec2 code, out bool there) {
  there = code.x != -32768;
  vec2 p = vec2(code) / 32767.0;
  vec3 n = vec3(p, 1.0 - abs(p.x) - abs(p.y));
  float fold = max(-n.z, 0.0);
  n.xy -= vec2(n.x < 0.0 ? -fold : fold, n.y < 0.0 ? -fold : fold);
  return there ? normalize(n) : vec3(0.0, 0.0, 1.0);
}

void basis(vec3 d, out float y[${count}]) {
  ${basisSource(bands)}
}

vec3 linearOf(vec3 c) {
  return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c));
}

vec3 diverging(float t) {
  t = clamp(t, -1.0, 1.0);
  return t < 0.0 ? mix(vec3(0.93), vec3(0.10, 0.35, 0.72), -t) : mix(vec3(0.93), vec3(0.80, 0.33, 0.02), t);
}

// Black through red and yellow to white, evenly brighter
vec3 heat(float t) {
  t = clamp(t, 0.0, 1.0);
  return clamp(vec3(t * 2.2, t * 2.0 - 0.55, t * 3.0 - 2.0), 0.0, 1.0) + vec3(0.06, 0.04, 0.12) * (1.0 - t);
}

void main() {
  vec3 place = u_corner + u_edge * a_place;
  gl_Position = u_clip * vec4(place, 1.0);
  int octant = (a_place.x >= 0.5 ? 1 : 0) + (a_place.y >= 0.5 ? 2 : 0) + (a_place.z >= 0.5 ? 4 : 0);
  gl_PointSize = clamp(2.0 * u_spacing[octant] * u_pixels / max(gl_Position.w, 1e-6), 1.5, 48.0);
  v_id = ivec2(u_node, gl_VertexID);
  float v[${count}];
  ${unpack}
  bool there;
  vec3 n = normalOf(a_normal, there);
  // Over the sphere a face is lit from the side that is seen
  if (u_sphere && there && dot(n, place) > 0.0) n = -n;
  float y[${count}];
  basis(n, y);
  vec3 color = vec3(0.0);
  if (u_show == 0) {
    int rows = there ? u_rows : 1;
    for (int k = 0; k < rows; k += 1) {
      float weight = u_rows == 1 ? 1.0 : (there ? y[k] : 0.28209479);
      for (int j = 0; j < ${count}; j += 1) color += weight * v[j] * texelFetch(u_matrix, ivec2(j, k), 0).rgb;
    }
    color = max(color * linearOf(a_albedo.rgb), 0.0) * u_exposure;
    color = mix(12.92 * color, 1.055 * pow(max(color, vec3(1e-6)), vec3(1.0 / 2.4)) - 0.055, step(0.0031308, color));
  } else if (u_show == 1) {
    color = vec3(pow(clamp(v[0] / u_open, 0.0, 1.0), 1.0 / 2.2));
  } else if (u_show == 2) {
    ${bands > 1 ? "vec3 bent = vec3(v[3], v[1], v[2]); color = length(bent) > 1e-6 ? 0.5 + 0.5 * normalize(bent) : vec3(0.5);" : "color = vec3(0.5);"}
  } else if (u_show == 3) {
    color = a_albedo.rgb;
  } else if (u_show == 4) {
    color = there ? 0.5 + 0.5 * n : vec3(0.5);
  } else if (u_show == 5) {
    // A noise of 0.03 is one that people see
    color = heat(a_error * u_exposure / 0.03);
  } else {
    int l = u_show - 10;
    float sum = 0.0;
    for (int j = 0; j < ${count}; j += 1) if (j >= l * l && j < (l + 1) * (l + 1)) sum += v[j] * y[j];
    color = diverging(sum * 2.0 * u_exposure);
  }
  v_color = clamp(color, 0.0, 1.0);
}`;
}

/** The fragment shader of points: their colour, or which they are. */
export const pointFragment = `#version 300 es
precision highp float;
precision highp int;
in vec3 v_color;
flat in ivec2 v_id;
uniform bool u_pick;
out vec4 color;
void main() {
  vec2 p = gl_PointCoord - 0.5;
  if (dot(p, p) > 0.25) discard;
  if (u_pick) color = vec4(float(v_id.x & 255), float((v_id.x >> 8) & 255), float(v_id.y & 255), float((v_id.y >> 8) & 255)) / 255.0;
  else color = vec4(v_color, 1.0);
}`;

/** A triangle over all of the view. */
export const wholeVertex = `#version 300 es
out vec2 v_at;
void main() {
  v_at = vec2(gl_VertexID == 1 ? 2.0 : 0.0, gl_VertexID == 2 ? 2.0 : 0.0);
  gl_Position = vec4(2.0 * v_at - 1.0, 0.0, 1.0);
}`;

/** The difference of two pictures: orange where the first is brighter, blue where the second is; grey where both are alike. */
export const differenceFragment = `#version 300 es
precision highp float;
in vec2 v_at;
uniform sampler2D u_first;
uniform sampler2D u_second;
uniform float u_gain;
out vec4 color;
void main() {
  vec4 a = texture(u_first, v_at);
  vec4 b = texture(u_second, v_at);
  if (a.a == 0.0 && b.a == 0.0) discard;
  float t = clamp(u_gain * dot(a.rgb - b.rgb, vec3(0.2126, 0.7152, 0.0722)), -1.0, 1.0);
  vec3 shown = t < 0.0 ? mix(vec3(0.90), vec3(0.10, 0.35, 0.72), -t) : mix(vec3(0.90), vec3(0.80, 0.33, 0.02), t);
  // Where only one of the two has a point there is no difference to tell
  color = a.a > 0.0 && b.a > 0.0 ? vec4(shown, 1.0) : vec4(0.55, 0.55, 0.55, 1.0);
}`;
