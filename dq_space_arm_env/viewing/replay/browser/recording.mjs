// What the page was given: solids, flights and curves, out of one block of base 64.

import { blendPoses, positionOf } from "./algebra.mjs";

const ARRAYS = { float32: Float32Array, int8: Int8Array, uint8: Uint8Array, uint16: Uint16Array };

/** Read the data of the page. */
export function readRecording(text) {
  const data = JSON.parse(text);
  const letters = atob(data.blob);
  const bytes = new Uint8Array(letters.length);
  // Of a long flight these are tens of millions: a loop takes a tenth of a second, a callback for each seconds.
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  const array = (place) => new ARRAYS[place.type](bytes.buffer, place.start, place.length);
  const { solids, view, constraints = null } = data;
  for (const each of constraints ? [solids, constraints] : [solids]) {
    for (const name of ["positions", "normals", "colors", "triangles"]) each[name] = array(each[name]);
  }
  if (constraints) for (const name of ["violated", "broken", "gas"]) constraints[name] = constraints[name].map(array);
  view.points = array(view.points);
  const frameCount = solids.counts.length - 4; // the last are those of target, its body, payload and inertial frame
  const poses = (place) => (place && !Array.isArray(place) ? array(place) : place);
  const flights = data.flights.map((flight) => {
    const [target, targetBody, payload] = [flight.target, flight.targetBody, flight.payload].map(poses);
    const arrays = { frames: array(flight.frames), target, targetBody, payload };
    return new Flight({ ...flight, ...arrays }, frameCount);
  });
  const panels = data.panels.map((panel) => ({
    ...panel,
    curves: panel.curves.map(array),
    disturbed: panel.disturbed.map((place) => place && array(place)),
  }));
  return { scene: data.scene, solids, view, flights, panels, constraints };
}

/** A flight: its poses at any time; before its beginning the first, after its end the last. */
export class Flight {
  constructor(description, frameCount) {
    Object.assign(this, description); // label, steps, dt, note, verdict, target, targetBody, payload, frames
    this.frameCount = frameCount;
    // The poses of target, its body, payload and inertial frame come after the robot's.
    this.poses = new Float32Array(8 * (frameCount + 4));
    const inertial = [1, 0, 0, 0, 0, 0, 0, 0];
    const others = [this.target, this.targetBody ?? this.target, this.payload ?? this.frames.slice(-8), inertial];
    this.others = others.map((source, index) => ({
      source, // a pose, or one for each instant
      poses: this.poses.subarray(8 * (frameCount + index), 8 * (frameCount + index + 1)),
    }));
    for (const { source, poses } of this.others) poses.set(source.slice(0, 8));
  }

  get duration() {
    return this.steps * this.dt;
  }

  /** Set `poses` to those at a time, in s. */
  moveTo(time) {
    const place = Math.min(Math.max(time / this.dt, 0), this.steps);
    const before = Math.min(Math.floor(place), this.steps - 1);
    const size = 8 * this.frameCount;
    blendPoses(this.frames, before * size, (before + 1) * size, place - before, this.frameCount, this.poses);
    for (const { source, poses } of this.others) {
      if (source.length > 8) blendPoses(source, 8 * before, 8 * (before + 1), place - before, 1, poses);
    }
    if (!this.payload) this.poses.copyWithin(8 * (this.frameCount + 2), size - 8, size); // the tip holds it
  }

  /** Of the rows of a table, one number for each instant: which are set at a time, in s. */
  setAt(table, time) {
    const size = this.steps + 1, instant = Math.min(Math.floor(Math.max(time / this.dt, 0) + 1e-6), this.steps);
    return Array.from({ length: table.length / size }, (_, row) => table[row * size + instant] === 1);
  }

  /** Of the rows of a table, one for each instant: that at a time, in s. */
  rowAt(table, time) {
    const width = table.length / (this.steps + 1);
    const instant = Math.min(Math.floor(Math.max(time / this.dt, 0) + 1e-6), this.steps);
    return table.subarray(width * instant, width * (instant + 1));
  }

  /** Position of the tip at an instant. */
  tipAt(instant) {
    return positionOf(this.frames, 8 * ((instant + 1) * this.frameCount - 1));
  }

  get tip() {
    return positionOf(this.poses, 8 * (this.frameCount - 1));
  }

  get aim() {
    return positionOf(this.poses, 8 * this.frameCount);
  }
}
