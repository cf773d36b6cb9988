// Words in the picture, and the directions of the inertial axes in its corner.

const AXES = [["x", "#d62728"], ["y", "#21993d"], ["z", "#3b6fe0"]];
const CLOSE = 46; // CSS pixels; nearer words would lie on each other

export class Labels {
  constructor(container, compass) {
    this.words = ["target", "tip"].map((word) => {
      const span = document.createElement("span");
      span.textContent = word;
      container.append(span);
      return span;
    });
    const svg = (name) => compass.appendChild(document.createElementNS("http://www.w3.org/2000/svg", name));
    this.axes = AXES.map(([name, color]) => {
      const [line, text] = [svg("line"), svg("text")];
      line.setAttribute("stroke", color);
      text.setAttribute("fill", color);
      text.textContent = name;
      return [line, text];
    });
  }

  /** Move the words to where target and tip of a flight appear in a picture of a size in CSS pixels. */
  update(camera, flight, width, height) {
    const places = [flight.aim, flight.tip].map((point) => {
      const place = camera.project(point);
      return place && [place[0] * width, place[1] * height];
    });
    const [target, tip] = places;
    const apart = target && tip && Math.hypot(target[0] - tip[0], target[1] - tip[1]) > CLOSE;
    this.words.forEach((word, index) => {
      const place = places[index];
      word.hidden = !place || (index === 1 && !apart);
      if (place) word.style.transform = `translate(${place[0] + 12}px, ${place[1] + 10}px)`;
    });
    const { right, up } = camera.axes;
    this.axes.forEach(([line, text], axis) => {
      line.setAttribute("x2", 20 * right[axis]);
      line.setAttribute("y2", -20 * up[axis]);
      text.setAttribute("x", 27 * right[axis]);
      text.setAttribute("y", -27 * up[axis]);
    });
  }
}
