"use strict";
// The motion of the page: typed arrays in metres, seconds, radians and pixels, axes with z up.

const byId = (id) => document.getElementById(id);
const numbers = (list, unit) => Float32Array.from(list, (v) => (v === null ? NaN : v / unit));

const motion = (() => {
  const raw = JSON.parse(byId("motion").textContent);
  return {
    ...raw,
    count: raw.frames.length,
    root: raw.parents.indexOf(-1),
    times: numbers(raw.times, 1000),
    pose: numbers(raw.pose, 1000),
    camera: numbers(raw.camera, 1000),
    heading: numbers(raw.heading, 1000),
    keypoints: numbers(raw.keypoints, 10),
    people: raw.people && raw.people.map((one) => (
      { ...one, pose: numbers(one.pose, 1000), keypoints: numbers(one.keypoints, 10) })),
  };
})();

/** Who is drawn: the one person, or everybody. */
const bodies = motion.people ?? [motion];

const vec = {
  add: (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]],
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
};

const FOOT = 0.06; // m from the ankle to the floor

const slice3 = (array, at) => [array[at], array[at + 1], array[at + 2]];
const jointAt = (frame, joint, body = motion) => slice3(body.pose, 3 * (frame * motion.joints.length + joint));
const keypointAt = (frame, joint, body = motion) => {
  const at = 2 * (frame * motion.joints.length + joint);
  return [body.keypoints[at], body.keypoints[at + 1]];
};
const known = (point) => point.every(Number.isFinite);

/** Axes of the camera in one frame. */
function cameraAxes(frame) {
  const right = slice3(motion.camera, 6 * frame), forward = slice3(motion.camera, 6 * frame + 3);
  return { right, forward, down: vec.cross(forward, right) };
}

/** Mean of the known values of a list around a place. */
function meanAround(list, place, half) {
  const near = list.slice(Math.max(0, place - half), place + half + 1).filter(Number.isFinite);
  return near.length ? near.reduce((sum, v) => sum + v, 0) / near.length : NaN;
}

/**
 * Height of the floor in each frame. In the world it is constant, below the lowest joints of most frames.
 * In the camera's frame the height of the body is not known; it stands on its lowest joint.
 */
const floors = (() => {
  const lowest = Array.from({ length: motion.count }, (_, f) => {
    const heights = bodies.flatMap((body) => motion.joints.map((_, j) => jointAt(f, j, body)[2])).filter(Number.isFinite);
    return heights.length ? Math.min(...heights) : NaN;
  });
  const sorted = lowest.filter(Number.isFinite).sort((a, b) => a - b);
  const usual = (sorted[Math.floor(sorted.length * (bodies.length > 1 ? 0.2 : 0.05))] ?? 0) - FOOT;
  return lowest.map((_, f) => {
    const here = motion.world ? NaN : meanAround(lowest, f, 1) - FOOT;
    return Number.isFinite(here) ? here : usual;
  });
})();

/** Mean of the roots of all who are there in a frame. */
function middleOf(frame) {
  const there = bodies.map((body) => jointAt(frame, motion.root, body)).filter(known);
  return [0, 1, 2].map((axis) => there.reduce((sum, p) => sum + p[axis], 0) / there.length);
}

/** How many times as much room as one person everybody takes. */
const room = (() => {
  const away = [];
  if (bodies.length > 1) {
    for (let f = 0; f < motion.count; f++) {
      const middle = middleOf(f);
      const apart = bodies.map((body) => jointAt(f, motion.root, body)).filter(known)
        .map((p) => Math.hypot(p[0] - middle[0], p[1] - middle[1]));
      if (apart.length) away.push(Math.max(...apart));
    }
  }
  away.sort((a, b) => a - b);
  return 1 + (away[Math.floor(away.length * 0.9)] ?? 0) / 1.5;
})();

/** Target of the views in each frame: the root, smoothed over time, as people climb and a floor may be another's. */
const targets = (() => {
  const roots = Array.from({ length: motion.count }, (_, f) => middleOf(f));
  const columns = [0, 1].map((axis) => roots.map((p) => p[axis]));
  const above = roots.map((p, f) => p[2] - floors[f]);
  const height = (meanAround(above, 0, motion.count) || 0.9) - 0.02;
  let last = [0, 0];
  return roots.map((_, f) => {
    // As far on as back: a person who moves stays in the middle in the first and the last frames, too.
    const half = Math.min(8, f, motion.count - 1 - f);
    const place = [0, 1].map((axis) => meanAround(columns[axis], f, half));
    if (place.every(Number.isFinite)) last = place;
    const here = meanAround(above, f, half) - 0.02;
    return [...last, floors[f] + (Number.isFinite(here) ? here : height)];
  });
})();
