// A camera that turns around a point; z of the inertial frame points up in the picture.

import { along, dot, perspective, viewMatrix } from "./algebra.mjs";

const TANGENT = Math.tan((15 * Math.PI) / 180); // of half the vertical angle of view
const HIGHEST = (89.5 * Math.PI) / 180;
const MARGIN = 0.93; // share of the picture that the robot may fill

export class Camera {
  /** Look at what `view` names, in a picture of some width over height. */
  constructor(view) {
    this.view = view;
    this.aspect = 1;
    this.covered = 0;
    this.reset();
  }

  /** Go back to the first side, as near as everything stays in the picture. */
  reset() {
    this.azimuth = this.view.azimuth;
    this.elevation = this.view.elevation;
    this.moved = false;
    this.fit();
  }

  /** Adapt to a picture of some width over height, of which a share is covered at the top. */
  resize(aspect, covered) {
    this.aspect = aspect;
    this.covered = covered;
    if (!this.moved) this.fit();
  }

  /** The camera's axes: to the right, up, and back toward where it stands. */
  get axes() {
    const [sine, cosine] = [Math.sin(this.azimuth), Math.cos(this.azimuth)];
    const [high, level] = [Math.sin(this.elevation), Math.cos(this.elevation)];
    return {
      right: [-sine, cosine, 0],
      up: [-high * cosine, -high * sine, level],
      back: [level * cosine, level * sine, high],
    };
  }

  get eye() {
    return along(this.pivot, this.distance, this.axes.back);
  }

  /**
   * Choose pivot and distance. Two planes through the camera and opposite edges of the picture keep a point
   * between them if tangent * (distance along `back` from the point) >= |offset to the side|.
   */
  fit() {
    const { right, up, back } = this.axes;
    const { points } = this.view;
    const sides = [[right, MARGIN * TANGENT * this.aspect], [up, MARGIN * TANGENT * (1 - this.covered)]];
    let far = -Infinity;
    const place = sides.map(([axis, tangent]) => {
      let high = -Infinity, low = -Infinity;
      for (let i = 0; i < points.length; i += 3) {
        const point = points.subarray(i, i + 3);
        const [depth, offset] = [tangent * dot(point, back), dot(point, axis)];
        high = Math.max(high, depth + offset);
        low = Math.max(low, depth - offset);
      }
      far = Math.max(far, (high + low) / (2 * tangent));
      return (high - low) / 2;
    });
    const depth = dot(this.view.pivot, back);
    this.pivot = along(along(along([0, 0, 0], place[0], right), place[1], up), depth, back);
    this.distance = far - depth;
    this.nearest = this.distance / 12;
    this.farthest = this.distance * 6;
  }

  orbit(turn, lift) {
    this.azimuth += turn;
    this.elevation = Math.min(Math.max(this.elevation + lift, -HIGHEST), HIGHEST);
    this.moved = true;
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, this.nearest), this.farthest);
    this.moved = true;
  }

  /** Move sideways by shares of the picture's height. */
  pan(right, up) {
    const { axes } = this;
    const height = 2 * TANGENT * this.distance;
    this.pivot = along(along(this.pivot, right * height, axes.right), up * height, axes.up);
    this.moved = true;
  }

  /** How far away things are still drawn. */
  get end() {
    return 5 * this.distance + 30;
  }

  /** Matrices for the picture. */
  matrices() {
    const { right, up, back } = this.axes;
    return {
      view: viewMatrix(right, up, back, this.eye),
      projection: perspective(TANGENT, this.aspect, 0.04 * this.distance, this.end, this.covered),
    };
  }

  /** Where a point appears: from the left and from above as shares of the picture; null behind the camera. */
  project(point) {
    const { right, up, back } = this.axes;
    const offset = along(point, -1, this.eye);
    const depth = -dot(offset, back);
    if (depth <= 0) return null;
    const height = 2 * TANGENT * depth;
    return [0.5 + dot(offset, right) / (height * this.aspect), 0.5 * (1 + this.covered) - dot(offset, up) / height];
  }
}
