// Vectors, 4x4 matrices (column by column, as WebGL wants them) and dual quaternions (8 numbers, scalar first).

export function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/** The sum of a and s b. */
export function along(a, s, b) {
  return [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
}

export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/**
 * Perspective projection; `tangent` is that of half the vertical angle of view. The middle of the view appears
 * below that of the picture, by `lowered` times half the picture's height.
 */
export function perspective(tangent, aspect, near, far, lowered) {
  const depth = 1 / (near - far);
  return new Float32Array([
    1 / (tangent * aspect), 0, 0, 0,
    0, 1 / tangent, 0, 0,
    0, lowered, (near + far) * depth, -1,
    0, 0, 2 * near * far * depth, 0,
  ]);
}

/** From inertial axes to those of a camera at `eye`, which looks against `back`. */
export function viewMatrix(right, up, back, eye) {
  return new Float32Array([
    right[0], up[0], back[0], 0,
    right[1], up[1], back[1], 0,
    right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
  ]);
}

/** Position r = 2 q_d q_r* of the pose that begins at `start` in an array. */
export function positionOf(q, start = 0) {
  const real = [q[start + 1], q[start + 2], q[start + 3]], dual = [q[start + 5], q[start + 6], q[start + 7]];
  const turned = cross(real, dual);
  return [0, 1, 2].map((i) => 2 * (q[start] * dual[i] - q[start + 4] * real[i] + turned[i]));
}

/** The product of two matrices. */
export function multiply(a, b) {
  const result = new Float32Array(16);
  for (let column = 0; column < 16; column += 4) {
    for (let row = 0; row < 4; row++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + row] * b[column + k];
      result[column + row] = sum;
    }
  }
  return result;
}

/** Matrix from the axes of a frame to those that its pose refers to: q_r v q_r* + 2 q_d q_r*. */
export function poseMatrix(q, start) {
  const [w, x, y, z] = [q[start], q[start + 1], q[start + 2], q[start + 3]];
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
    ...positionOf(q, start), 1,
  ]);
}

/** Matrix from the axes of one frame, about the origin of another; those of number -1 are inertial. */
export function placedMatrix(poses, place, axes) {
  const identity = [1, 0, 0, 0, 0, 0, 0, 0];
  const matrix = axes < 0 ? poseMatrix(identity, 0) : poseMatrix(poses, 8 * axes);
  if (place !== axes) matrix.set(place < 0 ? [0, 0, 0] : positionOf(poses, 8 * place), 12);
  return matrix;
}

/**
 * Matrix from axes whose z is along a vector in a frame, about a point of that frame; they are scaled by the root of
 * the vector's length, which shows weak ones too.
 */
export function turnedMatrix(poses, place, point, vector) {
  const length = Math.hypot(...vector);
  const z = length > 0 ? [...vector].map((part) => part / length) : [0, 0, 1];
  const aside = Math.abs(z[0]) < 0.7 ? [1, 0, 0] : [0, 1, 0];
  const across = cross(z, aside);
  const y = across.map((part) => part / Math.hypot(...across));
  const scaled = [cross(y, z), y, z].map((axis) => [...axis.map((part) => Math.sqrt(length) * part), 0]);
  return multiply(poseMatrix(poses, 8 * place), new Float32Array([...scaled.flat(), ...point, 1]));
}

/**
 * Blend poses: `share` of the way from those at `from` to those at `to`, `count` of them in a row. The blend
 * of two near dual quaternions, made a unit again, is the screw motion between the two poses.
 */
export function blendPoses(source, from, to, share, count, result) {
  for (let k = 0; k < 8 * count; k += 8) {
    let length = 0, overlap = 0;
    for (let i = k; i < k + 8; i++) {
      result[i] = source[from + i] + share * (source[to + i] - source[from + i]);
    }
    for (let i = k; i < k + 4; i++) {
      length += result[i] * result[i];
      overlap += result[i] * result[i + 4];
    }
    const scale = 1 / Math.sqrt(length);
    for (let i = k; i < k + 4; i++) {
      result[i + 4] = scale * (result[i + 4] - (overlap / length) * result[i]);
      result[i] *= scale;
    }
  }
}
