// Joint angles and speeds beside the player: a person chooses which, and how much time.

const CHART = { height: 116, left: 36, right: 10, top: 8, bottom: 18 }; // px

/** Few round values that enclose low and high. */
function roundTicks(low, high, parts = 3.2) {
  const span = Math.max(high - low, 1e-6), rough = span / parts, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
  const first = Math.floor(low / step + 1e-9), last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(6)));
}

/** Runs of frames from first to last in which every list is known. */
function knownRuns(lists, first, last) {
  const runs = [];
  for (let f = first, open = false; f <= last; f++) {
    const here = lists.every((list) => Number.isFinite(list[f]));
    if (here && !open) runs.push([f, f]); else if (here) runs[runs.length - 1][1] = f;
    open = here;
  }
  return runs;
}

/** A chart: lines of both sides, their deviations as bands, a cursor, and their values at the shown frame. */
function makeChart(curve) {
  const digits = curve.unit === "°" ? 0 : 2, unit = curve.unit === "°" ? "°" : ` ${curve.unit}`;
  const lines = curve.sides.map((side, i) => ({
    side,
    values: numbers(curve.values[i], curve.scale),
    deviation: curve.deviation && numbers(curve.deviation[i], curve.scale),
  }));
  const all = lines.flatMap(({ values }) => Array.from(values).filter(Number.isFinite));
  const ticks = roundTicks(all.reduce((a, b) => Math.min(a, b), 0), all.reduce((a, b) => Math.max(a, b), 0));
  const low = ticks[0], high = ticks[ticks.length - 1];
  const said = (value) => `${value.toFixed(digits)}${unit}`;
  const named = (side) => (lines.length > 1 ? `${side} ` : "");
  const ranges = lines.map(({ side, values }) => {
    const known = values.filter(Number.isFinite);
    if (!known.length) return `${named(side)}unknown`;
    const mean = known.reduce((sum, v) => sum + v, 0) / known.length;
    return `${named(side)}${Math.min(...known).toFixed(digits)} to ${said(Math.max(...known))}, mean ${said(mean)}`;
  });
  const figure = document.createElement("figure");
  figure.innerHTML = `<figcaption><b>${curve.name}</b><output class="sides"></output></figcaption>
<svg class="chart" role="img" aria-label="${curve.name} over time"></svg><p>${ranges.join(" · ")}<br>${curve.words}</p>`;
  const svg = figure.querySelector("svg"), readout = figure.querySelector("output");
  let width = 0, from = 0, to = 1, at = () => 0;

  const level = (v) => CHART.height - CHART.bottom
    - ((Math.max(low, Math.min(high, v)) - low) / (high - low)) * (CHART.height - CHART.top - CHART.bottom);

  function body(first, last) {
    const place = (f, v) => `${at(motion.times[f]).toFixed(1)} ${level(v).toFixed(1)}`;
    const frames = ([a, b]) => Array.from({ length: b - a + 1 }, (_, i) => a + i);
    const bands = lines.filter(({ deviation }) => deviation).map(({ side, values, deviation }) => {
      const path = knownRuns([values, deviation], first, last).map(frames).map((run) => `M${[
        ...run.map((f) => place(f, values[f] + deviation[f])),
        ...run.reverse().map((f) => place(f, values[f] - deviation[f])),
      ].join("L")}Z`);
      return `<path class="band ${side}" d="${path.join("")}"/>`;
    });
    return bands.join("") + lines.map(({ side, values }) => {
      const path = knownRuns([values], first, last).map(frames).map((run) => `M${run.map((f) => place(f, values[f])).join("L")}`);
      return `<path class="line ${side}" d="${path.join("")}"/>`;
    }).join("");
  }

  function fill() {
    at = (t) => CHART.left + ((t - from) / (to - from)) * (width - CHART.left - CHART.right);
    const right = width - CHART.right, floor = CHART.height - CHART.bottom;
    const grid = ticks.map((tick) => `<line class="grid" x1="${CHART.left}" x2="${right}" y1="${level(tick)}" y2="${level(tick)}"/>
<text class="end" x="${CHART.left - 6}" y="${level(tick) + 4}">${tick}</text>`);
    const seconds = roundTicks(from, to, 5).filter((t) => t >= from && t <= to && t >= 0);
    const labels = seconds.map((t) => `<text class="middle" x="${Math.min(at(t), right - 8)}" y="${CHART.height - 4}">${t} s</text>`);
    svg.setAttribute("viewBox", `0 0 ${width} ${CHART.height}`);
    svg.innerHTML = grid.join("") + labels.join("") + body(frameAt(from), Math.min(frameAt(to) + 1, motion.count - 1))
      + `<line class="cursor" y1="${CHART.top}" y2="${floor}"/>${lines.map(({ side }) => `<circle class="dot ${side}" r="3.5"/>`).join("")}`;
  }

  const seek = (event) => {
    if (event.type === "pointermove" && !event.buttons) return;
    const x = event.clientX - svg.getBoundingClientRect().left;
    show(frameAt(from + ((x - CHART.left) / (width - CHART.left - CHART.right)) * (to - from)));
  };
  svg.addEventListener("pointerdown", seek);
  svg.addEventListener("pointermove", seek);
  return {
    figure,
    name: curve.name,
    /** Show a frame; `span` is the time around it in s, 0 = the whole motion. */
    move(frame, span) {
      const time = motion.times[frame], last = Math.max(motion.times[motion.count - 1], 1e-9);
      const [begin, end] = span ? [time - span / 2, time + span / 2] : [0, last];
      const wide = svg.clientWidth;
      if (!wide) return;
      if (wide !== width || begin !== from || end !== to) [width, from, to] = [wide, begin, end], fill();
      const x = at(time).toFixed(1), cursor = svg.querySelector(".cursor");
      cursor.setAttribute("x1", x);
      cursor.setAttribute("x2", x);
      svg.querySelectorAll(".dot").forEach((dot, i) => {
        const value = lines[i].values[frame];
        dot.style.display = Number.isFinite(value) ? "" : "none";
        if (Number.isFinite(value)) dot.setAttribute("cx", x), dot.setAttribute("cy", level(value).toFixed(1));
      });
      readout.innerHTML = lines.map(({ side, values, deviation }) => {
        const value = values[frame], error = deviation && Number.isFinite(deviation[frame]) ? ` ± ${deviation[frame].toFixed(digits)}` : "";
        return `<span class="${side}">${named(side)}${Number.isFinite(value) ? `<b>${said(value)}</b>${error}` : "–"}</span>`;
      }).join("");
    },
  };
}

const charts = {
  all: [],
  span: 0,
  move(frame) {
    for (const chart of this.all) if (!chart.figure.hidden) chart.move(frame, this.span);
  },
  /** Charts of one person, and buttons that show and hide them; what is chosen stays when the person changes. */
  fill(movement) {
    const before = this.all.filter(({ figure }) => !figure.hidden).map(({ name }) => name);
    const first = this.all.length === 0; // then the angles, and the speed of the whole body
    this.all = movement.map(makeChart);
    byId("charts").replaceChildren(...this.all.map(({ figure }) => figure));
    byId("choice").replaceChildren(...this.all.map(({ figure, name }) => {
      const button = document.createElement("button");
      const choose = (on) => {
        figure.hidden = !on;
        button.setAttribute("aria-pressed", String(on));
      };
      button.type = "button";
      button.textContent = name;
      button.addEventListener("click", () => { choose(figure.hidden); redraw(); });
      choose(first ? name.endsWith("bend") || name.startsWith("Pelvis") : before.includes(name));
      return button;
    }));
  },
};

(() => {
  byId("movement").hidden = !bodies.some(({ movement }) => movement.length);
  byId("whose").hidden = bodies.length < 2;
  for (const { name } of motion.people ?? []) byId("person").append(new Option(name, name, false, name === motion.lead));
  byId("person").addEventListener("change", ({ target }) => { charts.fill(bodies[target.selectedIndex].movement); redraw(); });
  byId("span").addEventListener("change", (event) => { charts.span = Number(event.target.value); redraw(); });
  charts.fill(motion.movement);
  new ResizeObserver(() => redraw()).observe(byId("charts"));
})();
