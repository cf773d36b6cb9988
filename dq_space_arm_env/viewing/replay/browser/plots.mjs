// The curves: drawn once, with a cursor that moves over them and follows clicks.

const LEFT = 44, RIGHT = 8, TOP = 5; // room around the curves, CSS pixels
const COLORS = 6; // of curves
// Of the first six curves of the solid flight and of ghosts, then of the next six, which have the same colors.
const DASHES = [[], [5, 3], [2, 2], [8, 3, 2, 3], [1, 3], [10, 4]];
const READING = 80; // ms
const DENSEST = 8; // values per CSS pixel that are drawn one by one
const NEAR = 2; // a bound is in view if it is less than this times as far out as the curves

/** Steps of 1, 2 or 5 times a power of ten that divide a range into about `count` parts. */
export function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].find((factor) => factor * power >= 0.999 * raw) * power;
  const first = Math.ceil(low / step - 1e-9), last = Math.floor(high / step + 1e-9);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Array.from({ length: Math.max(last - first + 1, 0) }, (_, i) => {
    const value = (first + i) * step;
    return { value, text: withMinus(value.toFixed(Math.min(decimals, 12))) };
  });
}

function withMinus(text) {
  return /^-0(\.0*)?$/.test(text) ? text.slice(1) : text.replace("-", "−");
}

/** Smallest and largest value that a panel shows: zero, the curves, and bounds near them. */
export function rangeOf(panel, flights) {
  let low = 0, high = 0;
  flights.forEach((flight, index) => {
    for (const curve of [panel.curves[index], panel.disturbed[index]]) {
      let values = curve ?? [];
      if (curve && flight.note) {
        // What diverged would flatten all the rest. Where most are zero, that cap is too.
        const sizes = Float32Array.from(curve, Math.abs).sort();
        const most = 3 * sizes[Math.floor(0.9 * (sizes.length - 1))];
        const cap = Math.max(most, ...panel.bounds.map(Math.abs)) || Infinity;
        values = curve.map((value) => Math.min(Math.max(value, -cap), cap));
      }
      for (const value of values) {
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
  });
  const [lowest, highest] = [low, high];
  for (const bound of panel.bounds) {
    if (bound > 0 && bound < NEAR * highest) high = Math.max(high, bound);
    if (bound < 0 && bound > NEAR * lowest) low = Math.min(low, bound);
  }
  if (low === high) [low, high] = [-1, 1];
  const room = 0.06 * (high - low);
  return [low < 0 ? low - room : 0, high > 0 ? high + room : 0];
}

/** One quantity. */
class Panel {
  constructor(panel, recording, player) {
    this.panel = panel;
    this.flights = recording.flights;
    this.player = player;
    this.range = rangeOf(panel, this.flights);
    const size = Math.max(-this.range[0], this.range[1]);
    // Tenths of a percent of the largest error, percents of the largest input.
    this.decimals = Math.min(Math.max(Math.ceil(Math.log10((panel.steps ? 50 : 300) / size)), 0), 6);
    this.element = document.createElement("figure");
    this.element.className = "panel";
    this.caption();
    this.area = this.append(this.element, "div", "area");
    this.canvas = this.append(this.area, "canvas");
    this.canvas.setAttribute("role", "img");
    this.cursor = this.append(this.area, "div", "cursor");
    this.follow();
  }

  append(parent, tag, className = "", text = "") {
    const element = document.createElement(tag);
    element.className = className;
    element.textContent = text;
    parent.append(element);
    return element;
  }

  caption() {
    const { panel } = this;
    const caption = this.append(this.element, "figcaption");
    const title = this.append(caption, "span", "title", `${panel.title} [${panel.unit}]`);
    this.append(title, "small", "", panel.note);
    this.values = this.append(caption, "span", "values");
  }

  /** Values at the cursor: of each flight where there is one curve, of each curve of the solid flight else. */
  fillValues(moment) {
    const single = this.panel.names.length === 1;
    const shown = this.flights.map((_, index) => index).filter((index) => moment.visible[index]);
    this.readouts = [];
    this.values.textContent = "";
    for (let curve = 0; curve < this.panel.names.length; curve++) {
      for (const flight of single && !this.panel.steps ? shown : [moment.solid]) {
        const entry = this.append(this.values, "span");
        const mark = single && !this.panel.steps ? "●" : this.panel.names[curve];
        const name = this.append(entry, "b", curve < COLORS ? "" : "dotted", mark);
        name.style.color = this.colorName(curve, flight);
        const value = this.append(entry, "span");
        value.style.minWidth = `${this.decimals + 3}ch`;
        this.readouts.push({ flight, curve, value });
      }
    }
  }

  colorName(curve, flight) {
    return this.panel.steps ? `var(--curve-${(curve % COLORS) + 1})` : `var(--flight-${flight + 1})`;
  }

  follow() {
    const seek = (event) => {
      const { left, width } = this.area.getBoundingClientRect();
      const share = (event.clientX - left - LEFT) / (width - LEFT - RIGHT);
      this.player.seek(share * this.player.duration);
    };
    this.area.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.area.setPointerCapture(event.pointerId);
      seek(event);
    });
    this.area.addEventListener("pointermove", (event) => {
      if (this.area.hasPointerCapture(event.pointerId)) seek(event);
    });
  }

  /** Draw anew: for another size, theme, or choice of flights. */
  draw(moment, style, pixel) {
    const { canvas } = this;
    this.width = this.area.clientWidth;
    this.height = this.area.clientHeight;
    canvas.width = Math.round(this.width * pixel);
    canvas.height = Math.round(this.height * pixel);
    const context = canvas.getContext("2d");
    context.setTransform(pixel, 0, 0, pixel, 0, 0);
    this.bottom = this.element.classList.contains("timed") ? 17 : 4;
    this.drawAxes(context, style);
    context.save();
    context.beginPath();
    context.rect(LEFT, TOP - 1, this.width - LEFT - RIGHT, this.height - TOP - this.bottom + 2);
    context.clip();
    // The solid flight last, on top.
    const order = this.flights.map((_, index) => index).filter((index) => moment.visible[index]);
    order.sort((one, other) => (one === moment.solid) - (other === moment.solid));
    for (const flight of order) this.drawFlight(context, style, flight, flight === moment.solid);
    context.restore();
    this.fillValues(moment);
    this.canvas.setAttribute("aria-label", this.describe(moment));
  }

  x(time) {
    return LEFT + (time / this.player.duration) * (this.width - LEFT - RIGHT);
  }

  y(value) {
    const [low, high] = this.range;
    return TOP + ((high - value) / (high - low)) * (this.height - TOP - this.bottom);
  }

  drawAxes(context, style) {
    const { width, height } = this;
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    context.textBaseline = "middle";
    context.textAlign = "right";
    const inside = height - TOP - this.bottom;
    for (const { value, text } of ticks(...this.range, Math.max(2, Math.round(inside / 20)))) {
      const y = Math.round(this.y(value)) + 0.5;
      this.line(context, style(value === 0 ? "--muted" : "--line"), LEFT, y, width - RIGHT, y);
      context.fillStyle = style("--muted");
      context.fillText(text, LEFT - 6, y);
    }
    const times = ticks(0, this.player.duration, (width - LEFT) / 70);
    times.forEach(({ value, text }, index) => {
      const x = Math.round(this.x(value)) + 0.5;
      this.line(context, style("--line"), x, TOP, x, height - this.bottom);
      if (this.bottom < 10) return;
      const last = index === times.length - 1;
      context.textAlign = last && x > width - 24 ? "right" : "center";
      context.fillText(last ? `${text} s` : text, last ? Math.min(x + 6, width - 1) : x, height - 7);
    });
    context.setLineDash([6, 4]);
    for (const bound of this.panel.bounds) {
      const y = Math.round(this.y(bound)) + 0.5;
      if (y >= TOP && y <= height - this.bottom) {
        this.line(context, style("--muted"), LEFT, y, width - RIGHT, y);
      }
    }
    context.setLineDash([]);
  }

  line(context, color, x1, y1, x2, y2) {
    context.strokeStyle = color;
    context.beginPath();
    context.moveTo(x1, y1);
    context.lineTo(x2, y2);
    context.stroke();
  }

  drawFlight(context, style, flight, solid) {
    const count = this.panel.names.length;
    for (let curve = 0; curve < count; curve++) {
      context.strokeStyle = style(this.colorName(curve, flight).slice(4, -1));
      const disturbed = this.panel.disturbed[flight];
      if (disturbed) {
        context.globalAlpha = 0.3;
        context.lineWidth = 1;
        this.stroke(context, disturbed, curve, flight);
      }
      context.globalAlpha = solid ? 1 : 0.75;
      context.lineWidth = solid ? 1.7 : 1.3;
      context.setLineDash(DASHES[(2 * Math.floor(curve / COLORS) + (solid ? 0 : 1)) % DASHES.length]);
      this.stroke(context, this.panel.curves[flight], curve, flight);
      context.setLineDash([]);
      context.globalAlpha = 1;
    }
  }

  stroke(context, curves, curve, flight) {
    const { steps, dt } = this.flights[flight];
    const length = steps + (this.panel.steps ? 0 : 1);
    const share = Math.ceil(length / (DENSEST * this.width));
    context.beginPath();
    if (share > 1) this.envelope(context, curves.subarray(curve * length, (curve + 1) * length), share, dt);
    for (let i = 0; i < length && share === 1; i++) {
      const y = this.y(curves[curve * length + i]);
      context.lineTo(this.x(i * dt), y);
      if (this.panel.steps) context.lineTo(this.x((i + 1) * dt), y);
    }
    context.stroke();
  }

  /** Go from the smallest to the largest of some values at a time, and on: it looks the same, and takes no seconds. */
  envelope(context, values, share, dt) {
    for (let start = 0; start < values.length; start += share) {
      const some = values.subarray(start, start + share);
      const [low, high] = [some.reduce((a, b) => Math.min(a, b)), some.reduce((a, b) => Math.max(a, b))];
      context.lineTo(this.x(start * dt), this.y(low));
      context.lineTo(this.x(start * dt), this.y(high));
    }
  }

  valueAt(flight, curve, time) {
    const { steps, dt } = this.flights[flight];
    const length = steps + (this.panel.steps ? 0 : 1);
    const place = this.panel.steps ? Math.floor(time / dt + 1e-6) : Math.round(time / dt);
    return this.panel.curves[flight][curve * length + Math.min(place, length - 1)];
  }

  describe(moment) {
    const { panel } = this;
    const { label, duration } = this.flights[moment.solid];
    const parts = panel.names.map((name, curve) => {
      const [first, last] = [0, duration].map((time) => this.format(this.valueAt(moment.solid, curve, time)));
      return `${name ? `${name} ` : ""}from ${first} to ${last} ${panel.unit}`;
    });
    return `${panel.title} over time, ${label}: ${parts.join(", ")}; ${panel.note}`;
  }

  format(value) {
    return withMinus(value.toFixed(this.decimals));
  }

  moveCursor(time) {
    this.cursor.style.transform = `translateX(${this.x(time)}px)`;
  }

  showValues(time) {
    for (const { flight, curve, value } of this.readouts) {
      const text = this.format(this.valueAt(flight, curve, time));
      if (value.textContent !== text) value.textContent = text;
    }
  }
}

/** All panels. */
export class Plots {
  constructor(container, recording, player) {
    this.container = container;
    this.next = 0;
    this.panels = recording.panels.map((panel) => new Panel(panel, recording, player));
    container.append(...this.panels.map((panel) => panel.element));
  }

  draw(moment, style, pixel) {
    // In one column close together the times below the last panel serve all.
    const sparse = getComputedStyle(this.container).overflowY === "visible";
    this.panels.forEach((panel, index) => {
      const last = index === this.panels.length - 1;
      panel.element.classList.toggle("last", last);
      panel.element.classList.toggle("timed", sparse || last);
    });
    for (const panel of this.panels) panel.draw(moment, style, pixel);
    this.next = 0; // their numbers are to be written again
  }

  /** Follow the time; while it runs, numbers change no faster than one reads. */
  update(time, running, now) {
    for (const panel of this.panels) panel.moveCursor(time);
    if (running && now < this.next) return;
    this.next = now + READING;
    for (const panel of this.panels) panel.showValues(time);
  }
}
