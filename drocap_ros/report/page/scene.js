// Draws the pose of one frame from one direction.

const DISTANCE = 6; // m from the viewer to the subject
const CAMERA_RADIUS = 1.4; // m at which the camera is shown: its direction is known, its distance is not
const THICKNESS = { hip: 0.05, knee: 0.075, ankle: 0.055, neck: 0.055, head: 0.05, shoulder: 0.05, elbow: 0.05, wrist: 0.04 };

const thicknessOf = (name) => THICKNESS[name.replace(/^[lr]/, "")] ?? THICKNESS[name] ?? 0.04;

/** Present colours of the style sheet, light or dark. */
function palette() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  return Object.fromEntries(
    ["ground", "card", "text", "muted", "grid", "accent", "right", "left", "middle"].map((name) => [name, read(name)]),
  );
}

/** A hex colour moved towards another by a share. */
function mixed(from, to, share) {
  const parts = (c) => [1, 3, 5].map((i) => parseInt(c.slice(i, i + 2), 16));
  const a = parts(from), b = parts(to);
  return `rgb(${a.map((v, i) => Math.round(v + (b[i] - v) * share)).join(" ")})`;
}

/** Context of a canvas, sized to its box in device pixels, cleared. */
function prepared(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 3);
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  context.lineCap = context.lineJoin = "round";
  return { context, width, height };
}

/** Perspective projection around a target: world point to [x px, y px, nearness m, px per m]. */
function projector(width, height, view, target) {
  const { azimuth: a, elevation: e } = view;
  const towards = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
  const right = [-Math.sin(a), Math.cos(a), 0];
  const up = vec.cross(towards, right);
  const scale = Math.min(height / 2 / (view.reachUp ?? 1.12), width / 2 / (view.reachSide ?? 0.8)) * (view.zoom ?? 1) / room;
  return (point) => {
    const d = vec.add(point, target, -1);
    const near = vec.dot(d, towards);
    const s = (scale * DISTANCE * room) / Math.max(DISTANCE * room - near, 0.5);
    return [width / 2 + s * vec.dot(d, right), height / 2 - s * vec.dot(d, up), near, s];
  };
}

function line(context, points, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

function drawFloor(context, project, floor, target, colours) {
  const reach = 1.4 * room, step = 0.5;
  for (const axis of [0, 1]) {
    const other = 1 - axis;
    for (let k = Math.ceil((target[axis] - reach) / step); k * step < target[axis] + reach; k++) {
      const half = Math.sqrt(reach ** 2 - (k * step - target[axis]) ** 2);
      const ends = [-half, half].map((offset) => {
        const p = [0, 0, floor];
        p[axis] = k * step;
        p[other] = target[other] + offset;
        return project(p);
      });
      line(context, ends, colours.grid, 1);
    }
  }
}

function drawShadow(context, project, frame, colours, body) {
  context.save();
  context.globalAlpha = 0.13;
  context.strokeStyle = colours.text;
  context.beginPath();
  motion.parents.forEach((parent, joint) => {
    if (parent < 0) return;
    const ends = [jointAt(frame, parent, body), jointAt(frame, joint, body)];
    if (!ends.every(known)) return;
    const [a, b] = ends.map(([x, y]) => project([x, y, floors[frame]]));
    context.lineWidth = 0.07 * a[3];
    context.moveTo(a[0], a[1]);
    context.lineTo(b[0], b[1]);
  });
  context.stroke();
  context.restore();
}

/** A person's number above a place. */
function named(context, name, x, y, colour) {
  context.fillStyle = colour;
  context.font = "600 13px system-ui, sans-serif";
  context.textAlign = "center";
  context.fillText(name, x, y);
}

/** The body's parts in one frame, each with its nearness and its drawing function. */
function bodyParts(context, project, frame, colours, body) {
  const parts = [];
  const places = motion.joints.map((_, joint) => {
    const point = jointAt(frame, joint, body);
    return known(point) ? project(point) : null;
  });
  const shade = (side, near) => mixed(colours[side], colours.ground, Math.min(0.45, Math.max(0, 0.14 - near * 0.42)));
  const trunk = ["lshoulder", "rshoulder", "rhip", "lhip"].map((name) => places[motion.joints.indexOf(name)]);
  if (trunk.every(Boolean)) {
    parts.push({
      near: trunk.reduce((sum, p) => sum + p[2], 0) / 4 - 0.05,
      draw() {
        context.fillStyle = context.strokeStyle = mixed(colours.middle, colours.ground, 0.72);
        context.lineWidth = 0.1 * trunk[0][3];
        context.beginPath();
        trunk.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
        context.closePath();
        context.stroke();
        context.fill();
      },
    });
  }
  motion.parents.forEach((parent, joint) => {
    const a = places[parent], b = places[joint];
    if (!b || (parent >= 0 && !a)) return;
    if (parent >= 0) {
      const near = (a[2] + b[2]) / 2, width = Math.max(2, thicknessOf(motion.joints[joint]) * (a[3] + b[3]) / 2);
      parts.push({
        near,
        draw() {
          line(context, [a, b], colours.ground, width + 3);
          line(context, [a, b], shade(motion.sides[joint], near), width);
        },
      });
    }
    if (motion.joints[joint] === "head") {
      parts.push({
        near: b[2] + 0.01,
        draw() {
          context.fillStyle = shade("middle", b[2]);
          context.strokeStyle = colours.ground;
          context.lineWidth = 2;
          context.beginPath();
          context.arc(b[0], b[1], 0.1 * b[3], 0, 2 * Math.PI);
          context.fill();
          context.stroke();
          if (body.name) named(context, body.name, b[0], b[1] - 0.16 * b[3], colours.text);
        },
      });
    }
  });
  return parts;
}

/** The camera as a square pyramid, its path as a line, as seen from the subject. */
function cameraParts(context, project, frame, target, colours) {
  const at = (f) => vec.add(target, slice3(motion.camera, 6 * f + 3), -CAMERA_RADIUS * room);
  const { right, forward, down } = cameraAxes(frame);
  const apex = at(frame);
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
    project(vec.add(vec.add(vec.add(apex, forward, 0.26), right, 0.15 * x), down, 0.1 * y)));
  const tip = project(apex);
  const step = Math.max(1, Math.floor(motion.count / 400));
  const parts = [];
  if (motion.world) {
    for (let f = 0; f + step < motion.count; f += step) {
      const ends = [project(at(f)), project(at(f + step))];
      const colour = f < frame ? colours.accent : mixed(colours.accent, colours.ground, 0.7);
      parts.push({ near: ends[0][2], draw: () => line(context, ends, colour, 2) });
    }
  }
  parts.push({
    near: tip[2],
    draw() {
      context.fillStyle = mixed(colours.accent, colours.ground, 0.75);
      context.beginPath();
      corners.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.fill();
      line(context, [...corners, corners[0]], colours.accent, 1.8);
      corners.forEach((corner) => line(context, [tip, corner], colours.accent, 1.8));
    },
  });
  return parts;
}

/** Draw a frame; `view` has azimuth, elevation (rad), zoom, and whether the camera is shown. */
function drawScene(canvas, frame, view, colours) {
  const { context, width, height } = prepared(canvas);
  const target = targets[frame];
  const project = projector(width, height, view, target);
  drawFloor(context, project, floors[frame], target, colours);
  for (const body of bodies) drawShadow(context, project, frame, colours, body);
  const parts = bodies.flatMap((body) => bodyParts(context, project, frame, colours, body));
  if (view.showCamera) parts.push(...cameraParts(context, project, frame, target, colours));
  parts.sort((a, b) => a.near - b.near);
  parts.forEach((part) => part.draw());
}
