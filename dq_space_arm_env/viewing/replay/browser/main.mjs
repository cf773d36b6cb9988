// Puts the page together: reads the data, and draws whenever something has changed.

import { Camera } from "./camera.mjs";
import { listenToKeys, moveWithPointers } from "./gestures.mjs";
import { Labels } from "./labels.mjs";
import { Player } from "./player.mjs";
import { Plots } from "./plots.mjs";
import { readRecording } from "./recording.mjs";
import { Renderer } from "./renderer.mjs";
import { download, Video, videoKind } from "./video.mjs";

const PLAY = "M6 3.8v12.4a.8.8 0 0 0 1.2.7l9.6-6.2a.8.8 0 0 0 0-1.4L7.2 3.1A.8.8 0 0 0 6 3.8z";
const PAUSE = "M5 3h3.4v14H5zM11.6 3H15v14h-3.4z";
const SHARPEST = 2; // pixels of a canvas per CSS pixel
const REST = 180; // ms without a change after which the picture is drawn finely
const LAST = 300; // ms for which a video waits for its last picture

const find = (id) => document.getElementById(id);
// One element for each scene; the address says which is shown, and another one is another start of the page.
const parts = [...document.querySelectorAll(".replay-data")];
const chosen = parts.find((part) => `#${encodeURIComponent(part.dataset.scene)}` === location.hash) ?? parts[0];
const recording = readRecording(chosen.textContent);
const { scene, flights, constraints } = recording;
const player = new Player(
  Math.max(...flights.map((flight) => flight.duration)),
  Math.min(...flights.map((flight) => flight.dt)),
);
const camera = new Camera(recording.view);
const moment = { time: 0, solid: 0, visible: flights.map(() => true) };
moment.shown = constraints ? constraints.names.map(() => true) : [];
const canvas = find("view"), viewport = find("viewport"), slider = find("time"), root = document.documentElement;
const plots = new Plots(find("plots"), recording, player);
const labels = new Labels(find("labels"), find("compass"));
const renderer = makeRenderer();
let look = null, stale = true, waiting = false, resting = null, video = null;
const kind = renderer && videoKind(canvas);

/** Null where nothing can be drawn in 3-D; the rest of the page works without. */
function makeRenderer() {
  try {
    return Renderer.on(canvas, recording);
  } catch (error) {
    console.warn(error);
    return null;
  }
}

/** Value of a color of the style sheet. */
const style = (name) => getComputedStyle(root).getPropertyValue(name).trim();

function channels(name) {
  const color = style(name);
  return [1, 3, 5].map((start) => parseInt(color.slice(start, start + 2), 16) / 255);
}

function readLook() {
  return {
    skyTop: channels("--sky-top"),
    skyBottom: channels("--sky-bottom"),
    star: channels("--star"),
    starOpacity: Number(style("--star-opacity")),
    grid: channels("--grid"),
    ambient: Number(style("--ambient")),
    bubble: channels("--bubble"),
    ahead: Number(style("--trail-ahead")),
    kept: channels("--kept"),
    violated: channels("--violated"),
    flights: flights.map((_, index) => channels(`--flight-${index + 1}`)),
  };
}

/** Ask for a picture; `everything` also for plots, which are drawn once otherwise. */
function refresh(everything = false) {
  stale ||= everything;
  clearTimeout(resting);
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(drawNow);
}

function drawNow(now) {
  waiting = false;
  player.tick(now);
  moment.time = player.time;
  if (stale) {
    stale = false;
    look = readLook();
    plots.draw(moment, style, Math.min(window.devicePixelRatio, SHARPEST));
  }
  for (const flight of flights) flight.moveTo(player.time);
  if (renderer && !renderer.gl.isContextLost()) {
    drawPicture(density());
    // Without a graphics processor pictures are coarse while they move, and fine when they rest.
    if (renderer.slow && !player.playing && !video) resting = setTimeout(() => drawPicture(SHARPEST), REST);
  }
  plots.update(player.time, player.playing, now);
  showTime();
  if (constraints) showConstraints();
  if (player.playing) refresh();
}

/** Pixels per CSS pixel of a picture that moves. */
const density = () => (renderer.slow ? 1 : Math.min(window.devicePixelRatio, SHARPEST));

/** Draw the robot with a number of pixels per CSS pixel. */
function drawPicture(pixel) {
  const [width, height] = [viewport.clientWidth, viewport.clientHeight];
  // Even, as videos must be.
  const [across, down] = [width, height].map((size) => 2 * Math.round((size * pixel) / 2));
  if (!video && (canvas.width !== across || canvas.height !== down)) { // a video keeps its size
    [canvas.width, canvas.height] = [across, down];
    const legend = find("flights");
    camera.resize(width / height, Math.min((legend.offsetTop + legend.offsetHeight) / height, 0.4));
  }
  renderer.draw(camera, moment, look, pixel);
  labels.update(camera, flights[moment.solid], width, height);
}

function showTime() {
  const digits = Math.min(Math.max(0, Math.ceil(-Math.log10(scene.dt))), 3);
  const [now, end] = [player.time.toFixed(digits), player.duration.toFixed(digits)];
  slider.value = player.time;
  slider.setAttribute("aria-valuetext", `${now} of ${end} seconds`);
  find("now").textContent = now;
  find("end").textContent = ` / ${end} s`;
}

function showControls() {
  find("play-shape").setAttribute("d", player.playing ? PAUSE : PLAY);
  find("play").setAttribute("aria-label", player.playing ? "Pause" : "Play");
  find("play").title = player.playing ? "Pause (Space)" : "Play (Space)";
  find("speed").value = String(player.speed);
  find("loop").setAttribute("aria-pressed", String(player.loop));
  find("record").setAttribute("aria-pressed", String(video !== null));
  find("record").title = video ? "End the video (V)" : "Record a video (V)";
  find("record").setAttribute("aria-label", find("record").title);
}

/** Play from the beginning, and record the picture until playback ends or is paused. */
function record() {
  if (kind === null) return;
  if (video) {
    player.pause();
    return;
  }
  player.loop = false;
  clearTimeout(resting);
  drawPicture(density());
  player.seek(0);
  video = new Video(canvas, kind);
  player.play();
}

function endVideo() {
  const ended = video;
  ended.ending = true;
  setTimeout(() => {
    video = null;
    ended.stop((file) => download(file, `${scene.name}-${flights[moment.solid].label}`));
    showControls();
    refresh();
  }, LAST);
}

function showFlights() {
  const rows = find("flights").querySelectorAll(".flight");
  rows.forEach((row, index) => {
    row.classList.toggle("solid", index === moment.solid);
    row.classList.toggle("ghost", index !== moment.solid);
    row.classList.toggle("off", !moment.visible[index]);
    const [box, choice] = [row.querySelector("[type=checkbox]"), row.querySelector("[type=radio]")];
    if (box) box.checked = moment.visible[index];
    if (choice) choice.checked = index === moment.solid;
  });
  const ghosts = flights.filter((_, index) => index !== moment.solid && moment.visible[index]);
  const others = ghosts.length ? `; as ghosts: ${ghosts.map((flight) => flight.label).join(", ")}` : "";
  canvas.setAttribute("aria-label", `Spacecraft with arm, 3-D view of ${flights[moment.solid].label}${others}`);
  refresh(true);
}

/** A row for each flight: its color, whether it is seen, and, by its name, which one is solid. */
function buildFlights() {
  flights.forEach((flight, index) => {
    const row = document.createElement("div");
    row.className = "flight";
    row.style.setProperty("--color", `var(--flight-${index + 1})`);
    const add = (parent, tag, properties) => parent.appendChild(Object.assign(document.createElement(tag), properties));
    if (flights.length > 1) {
      const box = add(row, "input", { type: "checkbox", title: `Show ${flight.label}` });
      box.setAttribute("aria-label", box.title);
      box.addEventListener("change", () => {
        moment.visible[index] = box.checked;
        showFlights();
      });
    }
    const label = add(row, "label", { title: flights.length > 1 ? `Draw ${flight.label} solid (${index + 1})` : "" });
    if (flights.length > 1) {
      const choice = add(label, "input", { type: "radio", name: "solid", className: "unseen" });
      choice.addEventListener("change", () => choose(index));
    }
    add(label, "span", { className: "swatch" });
    const name = add(label, "span", { className: "name", textContent: flight.label });
    add(name, "span", { className: "verdict", textContent: flight.verdict });
    find("flights").append(row);
  });
}

/** A row for each constraint: whether its shapes, if any, are seen, and whether the solid flight violates it. */
function buildConstraints() {
  find("constraints").hidden = false;
  constraints.names.forEach((name, index) => {
    const label = document.createElement("label");
    const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
    box.addEventListener("change", () => {
      moment.shown[index] = box.checked;
      refresh();
    });
    label.append(...(constraints.owners.includes(index) ? [box] : []), name); // limits of joints have no shape
    find("constraints").append(label);
  });
}

function showConstraints() {
  const flight = flights[moment.solid];
  const broken = flight.setAt(constraints.broken[moment.solid], player.time);
  find("constraints").querySelectorAll("label").forEach((label, index) => label.classList.toggle("broken", broken[index]));
}

/** A list of the scenes in place of the name, where there are several. */
function buildScenes() {
  const list = find("scenes");
  for (const part of parts) list.append(new Option(part.dataset.scene, part.dataset.scene, false, part === chosen));
  list.hidden = parts.length === 1;
  find("scene-name").hidden = parts.length > 1;
  list.addEventListener("change", () => {
    location.hash = encodeURIComponent(list.value);
  });
  window.addEventListener("hashchange", () => location.reload());
}

function choose(index) {
  if (index >= flights.length) return;
  moment.solid = index;
  moment.visible[index] = true;
  showFlights();
}

const commands = {
  changed: () => refresh(),
  choose,
  loop() {
    player.loop = !player.loop;
    showControls();
  },
  ghosts() {
    const seen = moment.visible.some((visible, index) => visible && index !== moment.solid);
    moment.visible = moment.visible.map((visible, index) => (index === moment.solid ? visible : !seen));
    showFlights();
  },
  theme() {
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    window.name = root.dataset.theme; // which stays when the page starts again
    refresh(true);
  },
  record,
  help() {
    find("help").showModal();
  },
};

function connect() {
  player.changed = () => {
    showControls();
    refresh();
    if (video && !video.ending && !player.playing) endVideo();
  };
  // Rounded: a maximum that is short of the last step by a rounding error would put it out of reach.
  slider.max = Number(player.duration.toPrecision(12));
  slider.step = scene.dt;
  slider.addEventListener("input", () => player.seek(Number(slider.value)));
  find("play").addEventListener("click", () => player.toggle());
  find("speed").addEventListener("change", (event) => {
    player.speed = Number(event.target.value);
  });
  find("loop").addEventListener("click", commands.loop);
  find("record").addEventListener("click", commands.record);
  find("theme").addEventListener("click", commands.theme);
  find("help-button").addEventListener("click", commands.help);
  const reset = () => {
    camera.reset();
    refresh();
  };
  find("reset-view").addEventListener("click", reset);
  canvas.addEventListener("dblclick", reset);
  moveWithPointers(canvas, camera, refresh);
  listenToKeys({ player, camera, commands });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    renderer.build();
    refresh(true);
  });
  new ResizeObserver(() => refresh(true)).observe(viewport);
  new ResizeObserver(() => refresh(true)).observe(find("plots"));
}

function followTheme() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const apply = () => {
    root.dataset.theme = dark.matches ? "dark" : "light";
    refresh(true);
  };
  dark.addEventListener("change", apply);
  apply();
  if (["dark", "light"].includes(window.name)) root.dataset.theme = window.name;
}

find("scene-name").textContent = scene.name;
find("scene-description").textContent = scene.description;
find("scene-description").title = scene.description;
find("missing").hidden = renderer !== null;
find("record").hidden = kind === null;
viewport.classList.toggle("flat", renderer === null);
followTheme();
buildScenes();
buildFlights();
if (constraints) buildConstraints();
connect();
showControls();
showFlights();
if (!matchMedia("(prefers-reduced-motion: reduce)").matches) player.play();
