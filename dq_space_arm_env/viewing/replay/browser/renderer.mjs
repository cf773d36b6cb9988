// Draws a moment of the flights with WebGL: one flight solid, the others as ghosts.

import { dot, multiply, placedMatrix, positionOf, turnedMatrix } from "./algebra.mjs";
import { ball, grid, ribbon, stars } from "./shapes.mjs";
import { GRID_SHADERS, RIBBON_SHADERS, SKY_SHADERS, SOLID_SHADERS, STAR_SHADERS } from "./shaders.mjs";

const STARS = 1200; // over the whole sky, of which a picture shows a few percent
const RIBBON_WIDTH = 3.2; // CSS pixels
const GHOST_OPACITY = 0.5;
const CONSTRAINT_OPACITY = 0.5; // at the rim of a shape
const GAS = -2; // axes of which z is where gas goes: that of the net force, and below it that of each thruster
const GHOST_TINT = 0.75;
const GHOST_GLOW = 0.25; // so that a ghost is seen against a dark sky

export class Renderer {
  /** Returns null where there is no WebGL. */
  static on(canvas, recording) {
    const slow = hasSlowGraphics();
    const gl = canvas.getContext("webgl", { antialias: !slow, alpha: false, powerPreference: "low-power" });
    return gl && new Renderer(gl, recording, slow);
  }

  constructor(gl, recording, slow) {
    this.gl = gl;
    this.recording = recording;
    this.slow = slow;
    this.build();
  }

  /** Hand programs and shapes to the graphics processor; again when it has lost them. */
  build() {
    const { gl } = this;
    const { solids, flights, scene, constraints } = this.recording;
    this.programs = {
      solid: this.program(SOLID_SHADERS),
      ribbon: this.program(RIBBON_SHADERS),
      star: this.program(STAR_SHADERS),
      grid: this.program(GRID_SHADERS),
      sky: this.program(SKY_SHADERS),
    };
    // Frame by frame: where its triangles begin, and how many there are; the last four frames are those of target,
    // its body and payload, and the inertial one, in which goals of other tips may be.
    this.parts = partsOf(solids.counts);
    const [target, body, payload, goals] = this.parts.slice(-4);
    this.targetParts = [target, body, goals];
    this.robotParts = [...this.parts.slice(0, -4), payload];
    this.robot = this.solid(solids);
    if (constraints) {
      this.constraints = this.solid(constraints);
      const [frames, parts] = [constraints.frames, partsOf(constraints.counts)];
      this.constraintParts = parts.map((part, index) => ({
        ...part,
        frame: frames[index][0],
        axes: frames[index][1],
        point: constraints.nozzles[index],
      }));
    }
    const bubble = ball(scene.tolerance);
    this.bubble = this.solid(bubble);
    this.bubbleParts = [{ frame: this.parts.length - 4, start: 0, count: bubble.triangles.length / 3 }];
    this.ribbons = flights.map((flight) => {
      const { positions, directions, places, vertexCount } = ribbon(flight);
      return {
        a_position: [this.buffer(positions), 3],
        a_direction: [this.buffer(directions), 3],
        a_place: [this.buffer(places), 2],
        vertexCount,
      };
    });
    const size = 8 * solids.axisLength;
    const lines = grid(size, size / 10);
    this.backgrounds = {
      star: { a_star: [this.buffer(stars(STARS)), 4], vertexCount: STARS },
      grid: { a_position: [this.buffer(lines), 3], vertexCount: lines.length / 3 },
      sky: { a_corner: [this.buffer(new Float32Array([-1, -1, 3, -1, -1, 3])), 2], vertexCount: 3 },
    };
    this.gridRadius = size;
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    gl.depthFunc(gl.LEQUAL);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); // colors are multiplied by their opacity
    gl.polygonOffset(1, 2);
  }

  program(sources) {
    const { gl } = this;
    const program = gl.createProgram();
    [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, index) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, sources[index]);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`the graphics driver refuses a program: ${gl.getProgramInfoLog(program)}`);
    }
    const names = (count, active) =>
      Array.from({ length: gl.getProgramParameter(program, count) }, (_, index) => active(index).name);
    const uniforms = names(gl.ACTIVE_UNIFORMS, (index) => gl.getActiveUniform(program, index));
    const attributes = names(gl.ACTIVE_ATTRIBUTES, (index) => gl.getActiveAttrib(program, index));
    return {
      program,
      uniforms: Object.fromEntries(
        uniforms.map((name) => [name.replace("[0]", ""), gl.getUniformLocation(program, name)]),
      ),
      attributes: Object.fromEntries(attributes.map((name) => [name, gl.getAttribLocation(program, name)])),
    };
  }

  buffer(array, kind = this.gl.ARRAY_BUFFER) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(kind, buffer);
    gl.bufferData(kind, array, gl.STATIC_DRAW);
    return buffer;
  }

  solid({ positions, normals, colors, triangles }) {
    return {
      a_position: [this.buffer(positions), 3],
      a_normal: [this.buffer(normals), 4, this.gl.BYTE],
      a_color: [this.buffer(colors), 4, this.gl.UNSIGNED_BYTE],
      triangles: this.buffer(triangles, this.gl.ELEMENT_ARRAY_BUFFER),
    };
  }

  /** Make a program and the arrays of a shape current; returns the program's uniforms. */
  use(name, shape) {
    const { gl } = this;
    const { program, uniforms, attributes } = this.programs[name];
    gl.useProgram(program);
    for (let place = 0; place < 4; place++) gl.disableVertexAttribArray(place);
    for (const [attribute, place] of Object.entries(attributes)) {
      const [buffer, size, type = gl.FLOAT] = shape[attribute];
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, type !== gl.FLOAT, 0, 0);
    }
    const { both, projection } = this.matrices;
    if (uniforms.u_both) gl.uniformMatrix4fv(uniforms.u_both, false, both);
    if (uniforms.u_projection) gl.uniformMatrix4fv(uniforms.u_projection, false, projection);
    return uniforms;
  }

  /**
   * Draw.
   * @param camera Where from.
   * @param moment {time, solid: number of the solid flight, visible: which are seen}
   * @param look Colors, as the theme has them.
   * @param pixel Pixels of the canvas per CSS pixel.
   */
  draw(camera, moment, look, pixel) {
    const { gl } = this;
    const { flights } = this.recording;
    const { view, projection } = camera.matrices();
    this.axes = camera.axes;
    this.matrices = { view, projection, both: multiply(projection, view) };
    this.look = look;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.drawBackground(pixel);
    const ghosts = flights.map((_, index) => index).filter((i) => moment.visible[i] && i !== moment.solid);
    const front = flights[moment.solid];
    gl.disable(gl.BLEND);
    const parts = moment.visible[moment.solid] ? this.parts : this.targetParts;
    this.drawSolid(front, { shape: this.robot, parts, tint: [0, 0, 0, 0], opacity: 1 });
    gl.enable(gl.BLEND);
    gl.depthMask(false);
    // Where paths coincide, that of the solid flight is on top.
    for (const index of [...ghosts, moment.solid]) {
      if (moment.visible[index]) this.drawRibbon(flights[index], index, moment.time, pixel);
    }
    gl.depthMask(true);
    for (const index of ghosts) this.drawGhost(flights[index], look.flights[index]);
    gl.depthMask(false);
    const tint = [...look.bubble, 1];
    if (this.constraints) this.drawConstraints(front, moment);
    this.drawSolid(front, { shape: this.bubble, parts: this.bubbleParts, tint, opacity: 0.55, rim: 1 });
    gl.depthMask(true);
  }

  drawBackground(pixel) {
    const { gl, look } = this;
    gl.disable(gl.BLEND);
    gl.depthMask(false);
    const sky = this.use("sky", this.backgrounds.sky);
    gl.uniform3fv(sky.u_top, look.skyTop);
    gl.uniform3fv(sky.u_bottom, look.skyBottom);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.enable(gl.BLEND);
    if (this.recording.scene.planar) {
      const uniforms = this.use("grid", this.backgrounds.grid);
      const [x, y] = this.recording.view.pivot;
      const spacing = this.gridRadius / 10;
      const below = Math.min(...this.recording.view.points.filter((_, index) => index % 3 === 2));
      gl.uniform3f(uniforms.u_center, Math.round(x / spacing) * spacing, Math.round(y / spacing) * spacing, below);
      gl.uniform3fv(uniforms.u_color, look.grid);
      gl.uniform1f(uniforms.u_radius, this.gridRadius);
      gl.drawArrays(gl.LINES, 0, this.backgrounds.grid.vertexCount);
    } else {
      const uniforms = this.use("star", this.backgrounds.star);
      gl.uniform1f(uniforms.u_pixel, pixel);
      gl.uniform3fv(uniforms.u_color, look.star);
      gl.uniform1f(uniforms.u_opacity, look.starOpacity);
      gl.drawArrays(gl.POINTS, 0, STARS);
    }
    gl.depthMask(true);
  }

  drawSolid(flight, { shape, parts, tint, opacity, rim = 0, glow = 0, gas = null }) {
    const { gl } = this;
    const uniforms = this.use("solid", shape);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, shape.triangles);
    gl.uniform4fv(uniforms.u_tint, tint);
    gl.uniform1f(uniforms.u_opacity, opacity);
    gl.uniform1f(uniforms.u_rim, rim);
    gl.uniform1f(uniforms.u_ambient, this.look.ambient + glow);
    for (const { frame, axes = frame, point, start, count } of parts) {
      if (count === 0) continue;
      const { poses } = flight;
      const blown = axes <= GAS ? gas.subarray(3 * (GAS - axes), 3 * (GAS - axes) + 3) : null;
      const place = blown ? turnedMatrix(poses, frame, point, blown) : placedMatrix(poses, frame, axes);
      const matrix = multiply(this.matrices.view, place);
      gl.uniformMatrix4fv(uniforms.u_frame, false, matrix);
      gl.drawElements(gl.TRIANGLES, 3 * count, gl.UNSIGNED_SHORT, 6 * start);
    }
  }

  /** Cones and volumes of the constraints that the flight in front must keep to; red where it does not. */
  drawConstraints(flight, { solid, time, shown }) {
    const { gl, look } = this;
    const { violated, owners, gas } = this.recording.constraints;
    const blown = gas.length ? flight.rowAt(gas[solid], time) : null;
    const broken = flight.setAt(violated[solid], time);
    gl.disable(gl.CULL_FACE); // cones are open
    for (const state of [false, true]) {
      const parts = this.constraintParts.filter((_, index) => shown[owners[index]] && broken[index] === state);
      const tint = [...(state ? look.violated : look.kept), 1];
      const seen = { tint, opacity: CONSTRAINT_OPACITY, rim: 1, glow: 0.3, gas: blown };
      this.drawSolid(flight, { shape: this.constraints, parts, ...seen });
    }
    gl.enable(gl.CULL_FACE);
  }

  /**
   * Depth first, then color: of a ghost only the surfaces are seen that one would see of a solid. Slow graphics
   * do without the first, and draw near parts before far ones, which comes close to it.
   */
  drawGhost(flight, color) {
    const { gl } = this;
    const ghost = {
      shape: this.robot,
      parts: [...this.robotParts],
      tint: [...color, GHOST_TINT],
      opacity: GHOST_OPACITY,
      glow: GHOST_GLOW,
    };
    gl.enable(gl.POLYGON_OFFSET_FILL); // what coincides with the solid flight stays behind it
    if (this.slow) {
      const { back } = this.axes;
      const nearness = ({ frame }) => dot(positionOf(flight.poses, 8 * frame), back);
      ghost.parts.sort((one, other) => nearness(other) - nearness(one));
    } else {
      gl.colorMask(false, false, false, false);
      this.drawSolid(flight, ghost);
      gl.colorMask(true, true, true, true);
    }
    this.drawSolid(flight, ghost);
    gl.disable(gl.POLYGON_OFFSET_FILL);
  }

  drawRibbon(flight, index, time, pixel) {
    const { gl, look } = this;
    const shape = this.ribbons[index];
    const uniforms = this.use("ribbon", shape);
    gl.disable(gl.CULL_FACE);
    gl.uniform2f(uniforms.u_size, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.uniform1f(uniforms.u_width, RIBBON_WIDTH * pixel);
    gl.uniform3fv(uniforms.u_color, look.flights[index]);
    gl.uniform1f(uniforms.u_now, time / flight.dt);
    gl.uniform1f(uniforms.u_last, flight.steps);
    gl.uniform1f(uniforms.u_ahead, look.ahead);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, shape.vertexCount);
    gl.enable(gl.CULL_FACE);
  }
}

/** Group by group: where its triangles begin, and how many there are. */
function partsOf(counts) {
  const starts = counts.map((_, group) => counts.slice(0, group).reduce((a, b) => a + b, 0));
  return counts.map((count, frame) => ({ frame, start: starts[frame], count }));
}

/** Whether pictures are computed without a graphics processor. */
function hasSlowGraphics() {
  const gl = document.createElement("canvas").getContext("webgl");
  if (!gl) return true;
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name = gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
