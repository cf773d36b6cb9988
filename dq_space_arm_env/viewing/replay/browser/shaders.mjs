// The programs of the graphics processor.

/** Solids, drawn frame by frame. */
export const SOLID_SHADERS = [
  `
attribute vec3 a_position, a_normal, a_color;
uniform mat4 u_frame, u_projection; // from the frame to the camera's axes, and on to the picture
varying vec3 v_normal, v_color, v_place;

void main() {
  vec4 place = u_frame * vec4(a_position, 1.0);
  v_place = place.xyz;
  v_normal = (u_frame * vec4(a_normal, 0.0)).xyz;
  v_color = a_color;
  gl_Position = u_projection * place;
}`,
  `
precision mediump float;
uniform vec4 u_tint; // color, and its share
uniform float u_opacity, u_ambient, u_rim;
varying vec3 v_normal, v_color, v_place;
// Directions toward the lights in the camera's axes.
const vec3 KEY = vec3(-0.48, 0.70, 0.53);
const vec3 FILL = vec3(0.80, -0.10, 0.59);

void main() {
  vec3 normal = normalize(v_normal), eye = normalize(-v_place);
  float light = u_ambient + 0.54 * max(dot(normal, KEY), 0.0) + 0.17 * max(dot(normal, FILL), 0.0);
  float gloss = 0.16 * pow(max(dot(reflect(-KEY, normal), eye), 0.0), 22.0);
  vec3 color = mix(v_color, u_tint.rgb, u_tint.a) * light + gloss;
  // A bubble is seen at its rim.
  float rim = pow(1.0 - abs(dot(normal, eye)), 2.0);
  float opacity = u_opacity * mix(1.0, 0.2 + 0.8 * rim, u_rim);
  gl_FragColor = vec4(color * opacity, opacity);
}`,
];

/** A ribbon of constant width in the picture along a path: bright behind the moving end, faint ahead of it. */
export const RIBBON_SHADERS = [
  `
attribute vec3 a_position, a_direction;
attribute vec2 a_place; // instant, and side: -1 or 1
uniform mat4 u_both; // from inertial axes to the picture
uniform vec2 u_size; // of the picture, pixels
uniform float u_width; // pixels
varying float v_instant, v_side;

void main() {
  vec4 here = u_both * vec4(a_position, 1.0), there = here + u_both * vec4(a_direction, 0.0);
  vec2 way = (there.xy / there.w - here.xy / here.w) * u_size;
  float size = length(way);
  vec2 across = size > 1e-4 ? vec2(-way.y, way.x) / size : vec2(0.0, 1.0);
  here.xy += a_place.y * across * u_width / u_size * here.w;
  v_instant = a_place.x;
  v_side = a_place.y;
  gl_Position = here;
}`,
  `
precision highp float;
uniform vec3 u_color;
uniform float u_now, u_last, u_ahead;
varying float v_instant, v_side;

void main() {
  float age = clamp((u_now - v_instant) / max(u_last, 1.0), 0.0, 1.0);
  float opacity = v_instant > u_now ? u_ahead : mix(0.95, 0.45, age);
  opacity *= 1.0 - smoothstep(0.6, 1.0, abs(v_side)); // soft edges
  gl_FragColor = vec4(u_color * opacity, opacity);
}`,
];

/** Stars, infinitely far away. */
export const STAR_SHADERS = [
  `
attribute vec4 a_star; // direction, and brightness
uniform mat4 u_both;
uniform float u_pixel;
varying float v_brightness;

void main() {
  vec4 place = u_both * vec4(a_star.xyz, 0.0);
  gl_Position = vec4(place.xy, 0.9999 * place.w, place.w);
  gl_PointSize = u_pixel * (1.3 + 1.7 * a_star.w);
  v_brightness = a_star.w;
}`,
  `
precision mediump float;
uniform vec3 u_color;
uniform float u_opacity;
varying float v_brightness;

void main() {
  float opacity = u_opacity * (0.25 + 0.75 * v_brightness);
  gl_FragColor = vec4(u_color * opacity, opacity);
}`,
];

/** The plane on which a planar base slides, as lines that fade with the distance. */
export const GRID_SHADERS = [
  `
attribute vec3 a_position;
uniform mat4 u_both;
uniform vec3 u_center;
varying vec2 v_offset;

void main() {
  v_offset = a_position.xy;
  gl_Position = u_both * vec4(a_position + u_center, 1.0);
}`,
  `
precision mediump float;
uniform vec3 u_color;
uniform float u_radius;
varying vec2 v_offset;

void main() {
  float opacity = 0.6 * (1.0 - smoothstep(0.2, 1.0, length(v_offset) / u_radius));
  gl_FragColor = vec4(u_color * opacity, opacity);
}`,
];

/** A vertical gradient behind everything. */
export const SKY_SHADERS = [
  `
attribute vec2 a_corner;
varying float v_height;

void main() {
  v_height = 0.5 + 0.5 * a_corner.y;
  gl_Position = vec4(a_corner, 0.99999, 1.0);
}`,
  `
precision mediump float;
uniform vec3 u_top, u_bottom;
varying float v_height;

void main() {
  gl_FragColor = vec4(mix(u_bottom, u_top, v_height), 1.0);
}`,
];
