// What is drawn besides the robot: the tip's path, stars, the plane of a planar scene, a ball.

const MOST_POINTS = 400; // of a path

/** The path of a flight's tip as a strip of triangles, two vertices at each point. */
export function ribbon(flight) {
  const stride = Math.ceil(flight.steps / MOST_POINTS);
  const instants = [];
  for (let instant = 0; instant < flight.steps; instant += stride) instants.push(instant);
  instants.push(flight.steps);
  const tips = instants.map((instant) => flight.tipAt(instant));
  const count = tips.length;
  const positions = new Float32Array(6 * count), directions = new Float32Array(6 * count);
  const places = new Float32Array(4 * count);
  let direction = [0, 0, 0];
  for (let i = 0; i < count; i++) {
    const [before, after] = [tips[Math.max(i - 1, 0)], tips[Math.min(i + 1, count - 1)]];
    const way = after.map((end, axis) => end - before[axis]);
    const length = Math.hypot(...way);
    // At rest the ribbon keeps its direction.
    if (length > 1e-7) direction = way.map((part) => (0.01 * part) / length);
    for (const side of [0, 1]) {
      positions.set(tips[i], 6 * i + 3 * side);
      directions.set(direction, 6 * i + 3 * side);
      places.set([instants[i], 2 * side - 1], 4 * i + 2 * side);
    }
  }
  return { positions, directions, places, vertexCount: 2 * count };
}

/** Directions of stars, evenly spread over the sky, with their brightness; always the same. */
export function stars(count) {
  const result = new Float32Array(4 * count);
  let state = 12345;
  const draw = () => {
    state = (1664525 * state + 1013904223) % 4294967296;
    return state / 4294967296;
  };
  for (let i = 0; i < count; i++) {
    const [height, around] = [2 * draw() - 1, 2 * Math.PI * draw()];
    const level = Math.sqrt(1 - height * height);
    result.set([level * Math.cos(around), level * Math.sin(around), height, draw() ** 3], 4 * i);
  }
  return result;
}

/** Lines of a square grid about the origin, out to a radius. */
export function grid(radius, spacing) {
  const points = [];
  const lines = Math.floor(radius / spacing);
  for (let line = -lines; line <= lines; line++) {
    const offset = line * spacing;
    const half = Math.sqrt(Math.max(radius * radius - offset * offset, 0));
    points.push(offset, -half, 0, offset, half, 0, -half, offset, 0, half, offset, 0);
  }
  return new Float32Array(points);
}

/** A ball about the origin of a frame, in the form of the robot's solids. */
export function ball(radius, sides = 24) {
  const rings = sides / 2;
  const directions = [], triangles = [];
  for (let i = 0; i <= rings; i++) {
    for (let j = 0; j <= sides; j++) {
      const [down, around] = [(Math.PI * i) / rings, (2 * Math.PI * j) / sides];
      directions.push([Math.sin(down) * Math.cos(around), Math.sin(down) * Math.sin(around), Math.cos(down)]);
      const [here, below] = [i * (sides + 1) + j, (i + 1) * (sides + 1) + j];
      if (i < rings && j < sides) triangles.push(here, below, below + 1, here, below + 1, here + 1);
    }
  }
  return {
    positions: new Float32Array(directions.flatMap((unit) => unit.map((part) => radius * part))),
    normals: new Int8Array(directions.flatMap((unit) => [...unit.map((part) => Math.round(127 * part)), 0])),
    colors: new Uint8Array(4 * directions.length).fill(255),
    triangles: new Uint16Array(triangles),
  };
}
