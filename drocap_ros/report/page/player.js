// Time, views and controls.

let pending = 0;
const state = { frame: 0, playing: false, speed: 1, overlay: true, view: "novel", colours: palette(), zoom: 1 };
const turned = { azimuth: motion.heading[0] + 0.75, elevation: 0.3 };
const ELEVATION = 0.09;

/** Viewing direction of a named view in a frame. */
function viewOf(name, frame) {
  const heading = motion.heading[frame];
  if (name === "front") return { azimuth: heading, elevation: ELEVATION };
  if (name === "profile") return { azimuth: heading + Math.PI / 2, elevation: ELEVATION };
  if (name === "camera") {
    const { forward } = cameraAxes(frame);
    return { azimuth: Math.atan2(-forward[1], -forward[0]), elevation: Math.asin(Math.max(-1, Math.min(1, -forward[2]))) };
  }
  return { ...turned, showCamera: true, reachUp: 1.22, reachSide: 1.5 };
}

function draw() {
  const { frame, colours } = state;
  drawScene(byId("main"), frame, { ...viewOf(state.view, frame), zoom: state.zoom }, colours);
  drawScene(byId("front"), frame, viewOf("front", frame), colours);
  drawScene(byId("profile"), frame, viewOf("profile", frame), colours);
  drawImagePane(byId("image"), frame, state.overlay, colours, redraw);
  byId("scrub").value = frame;
  byId("clock").textContent = `${motion.times[frame].toFixed(2)} s · frame ${motion.frames[frame]}`;
  for (const plot of plots) plot.move(frame);
  charts.move(frame);
}

function redraw() {
  if (!pending) pending = requestAnimationFrame(() => { pending = 0; draw(); });
}

function show(frame) {
  state.frame = Math.max(0, Math.min(motion.count - 1, Math.round(frame)));
  redraw();
}

/** Last frame at or before a time. */
function frameAt(seconds) {
  let low = 0, high = motion.count - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (motion.times[middle] <= seconds + 1e-6) low = middle; else high = middle - 1;
  }
  return low;
}

function play(on) {
  state.playing = on && motion.count > 1;
  byId("play").setAttribute("aria-label", state.playing ? "Pause" : "Play");
  if (!state.playing) return;
  const last = motion.times[motion.count - 1];
  let clock = state.frame === motion.count - 1 ? 0 : motion.times[state.frame], before = performance.now(), expected = -1;
  const tick = (now) => {
    if (!state.playing) return;
    if (expected >= 0 && expected !== state.frame) clock = motion.times[state.frame]; // moved by hand
    clock += ((now - before) / 1000) * state.speed;
    before = now;
    // The last frame lasts as long as the others.
    if (clock > last + last / (motion.count - 1)) clock = 0;
    expected = frameAt(clock);
    if (expected !== state.frame) show(expected);
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

function setView(name) {
  state.view = name;
  state.zoom = 1;
  for (const button of document.querySelectorAll("[data-view]")) {
    button.setAttribute("aria-pressed", String(button.dataset.view === name));
  }
  redraw();
}

/** Turning by hand starts from the present view and switches to the free one. */
function turn(dx, dy) {
  if (state.view !== "novel") {
    const { azimuth, elevation } = viewOf(state.view, state.frame);
    Object.assign(turned, { azimuth, elevation });
    setView("novel");
  }
  turned.azimuth -= 0.008 * dx;
  turned.elevation = Math.max(-0.4, Math.min(1.5, turned.elevation + 0.008 * dy));
  redraw();
}

function zoom(factor) {
  state.zoom = Math.max(0.4, Math.min(5, state.zoom * factor));
  redraw();
}

const plots = Array.from(document.querySelectorAll("svg.time"), (svg) => {
  const { series, unit } = svg.dataset, x0 = Number(svg.dataset.x0), x1 = Number(svg.dataset.x1);
  const cursor = svg.querySelector(".cursor"), readout = svg.closest("figure").querySelector(".readout");
  const last = Math.max(motion.times[motion.count - 1], 1e-9);
  const seek = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const box = svg.getBoundingClientRect();
    const x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
    show(frameAt(((x - x0) / (x1 - x0)) * last));
  };
  svg.addEventListener("pointerdown", seek);
  svg.addEventListener("pointermove", seek);
  return {
    move(frame) {
      cursor.setAttribute("transform", `translate(${((motion.times[frame] / last) * (x1 - x0)).toFixed(1)} 0)`);
      const value = motion.series[series][frame];
      readout.textContent = value === null ? "–" : `${value.toFixed(1)}${unit === "°" ? "" : " "}${unit}`;
    },
  };
});

function listen() {
  const canvas = byId("main"), pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const now = { x: event.clientX, y: event.clientY };
    if (pointers.size === 1) {
      turn(now.x - before.x, now.y - before.y);
      pointers.set(event.pointerId, now);
    } else {
      const wide = spread();
      pointers.set(event.pointerId, now);
      zoom(spread() / Math.max(wide, 1));
    }
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(-event.deltaY * 0.0012)); }, { passive: false });

  byId("play").addEventListener("click", () => play(!state.playing));
  byId("scrub").max = motion.count - 1;
  byId("scrub").addEventListener("input", (event) => show(Number(event.target.value)));
  byId("speed").addEventListener("change", (event) => { state.speed = Number(event.target.value); });
  byId("overlay").addEventListener("change", (event) => { state.overlay = event.target.checked; redraw(); });
  for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => setView(button.dataset.view));

  // A clicked button returns the keys to the player; a button focused by keyboard keeps them.
  document.addEventListener("click", (event) => {
    const active = document.activeElement;
    if (event.detail && active.matches("button, [type=checkbox]")) active.blur();
  });

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("select, summary")) return;
    if (event.key === " " && event.target.matches("button, [type=checkbox]")) return; // its own key
    const step = event.shiftKey ? 10 : 1;
    const actions = {
      " ": () => play(!state.playing),
      ArrowLeft: () => show(state.frame - step),
      ArrowRight: () => show(state.frame + step),
      Home: () => show(0),
      End: () => show(motion.count - 1),
      "+": () => zoom(1.15),
      "-": () => zoom(1 / 1.15),
      1: () => setView("front"),
      2: () => setView("profile"),
      3: () => setView("novel"),
      4: () => setView("camera"),
    };
    const action = actions[event.key];
    if (!action) return;
    event.preventDefault();
    if (event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End") play(false);
    action();
  });
  new ResizeObserver(redraw).observe(document.querySelector(".stage"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { state.colours = palette(); redraw(); });
}

listen();
if (!images) {
  byId("image-tag").textContent = "Body as found in the video";
  byId("overlay").closest("label").hidden = true;
}
setView("novel");
