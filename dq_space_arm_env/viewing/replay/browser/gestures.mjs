// Mouse, touch and keys.

const TURN = 0.0075; // rad per CSS pixel
const KEY_TURN = 0.08; // rad
const WHEEL = 0.0012;

/** Let pointers and the wheel move a camera; `changed` is called after each change. */
export function moveWithPointers(element, camera, changed) {
  const pointers = new Map();
  const middle = () => {
    const points = [...pointers.values()];
    const [x, y] = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
    const spread = points.length > 1 ? Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]) : 0;
    return { x, y, spread };
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    element.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  element.addEventListener("pointermove", (event) => {
    if (!pointers.has(event.pointerId)) return;
    const before = middle();
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle();
    const [right, down] = [after.x - before.x, after.y - before.y];
    if (pointers.size > 1 || event.shiftKey || event.buttons & 2) {
      camera.pan(-right / element.clientHeight, down / element.clientHeight);
      if (before.spread > 0 && after.spread > 0) camera.zoom(before.spread / after.spread);
    } else {
      camera.orbit(-TURN * right, TURN * down);
    }
    changed();
  });
  element.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      camera.zoom(Math.exp(WHEEL * lines * event.deltaY));
      changed();
    },
    { passive: false },
  );
  element.addEventListener("contextmenu", (event) => event.preventDefault());
}

/** Call what belongs to a key; keys that the focused element needs itself are left to it. */
export function listenToKeys({ player, camera, commands }) {
  const second = Math.max(Math.round(1 / player.dt), 1); // in time steps
  const keys = {
    " ": () => player.toggle(),
    arrowleft: (event) => player.step(event.shiftKey ? -second : -1),
    arrowright: (event) => player.step(event.shiftKey ? second : 1),
    home: () => player.seek(0),
    end: () => player.seek(player.duration),
    "[": () => player.shift(-1),
    "]": () => player.shift(1),
    l: commands.loop,
    w: () => camera.orbit(0, KEY_TURN),
    s: () => camera.orbit(0, -KEY_TURN),
    a: () => camera.orbit(-KEY_TURN, 0),
    d: () => camera.orbit(KEY_TURN, 0),
    "+": () => camera.zoom(0.9),
    "=": () => camera.zoom(0.9),
    "-": () => camera.zoom(1 / 0.9),
    r: () => camera.reset(),
    g: commands.ghosts,
    t: commands.theme,
    v: commands.record,
    "?": commands.help,
  };
  for (let number = 1; number <= 6; number++) keys[number] = () => commands.choose(number - 1);
  document.addEventListener("keydown", (event) => {
    // On many keyboards a bracket is typed with AltGr, which may count as Ctrl and Alt.
    const held = !event.getModifierState("AltGraph") && (event.ctrlKey || event.metaKey || event.altKey);
    if (held || document.querySelector("dialog[open]")) return;
    const own = event.target.closest("select, input, button");
    const press = event.key === " " && own && own.id !== "time";
    const choice = own && own.tagName === "SELECT" && event.key !== "?";
    const mark = own && own.type === "radio" && event.key.startsWith("Arrow");
    const action = keys[event.key.toLowerCase()];
    if (!action || press || choice || mark) return;
    event.preventDefault();
    action(event);
    commands.changed();
  });
}
