// The image of a frame with its 2D keypoints; without images the keypoints alone.

const images = motion.image && {
  ...motion.image,
  loaded: new Map(),
  /** Index of the image nearest to a frame. */
  nearest(frame) {
    let low = 0, high = this.places.length - 1;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.places[middle] < frame) low = middle + 1; else high = middle;
    }
    return low > 0 && frame - this.places[low - 1] < this.places[low] - frame ? low - 1 : low;
  },
  /** The image, or null while it is being decoded; `done` is called then. */
  decoded(index, done) {
    if (!this.loaded.has(index)) {
      const image = new Image();
      this.loaded.set(index, image);
      image.onload = done;
      image.src = `data:image/jpeg;base64,${this.jpeg[index]}`;
      // Few decoded images at a time: memory stays small on a phone.
      if (this.loaded.size > 60) this.loaded.delete(this.loaded.keys().next().value);
    }
    const image = this.loaded.get(index);
    return image.complete && image.naturalWidth ? image : null;
  },
};

/** Part of the picture that is shown where there are no images: x_min, y_min, x_max, y_max px. */
const keypointsBox = (() => {
  let box = [Infinity, Infinity, -Infinity, -Infinity];
  for (const { keypoints } of bodies) for (let i = 0; i < keypoints.length; i += 2) {
    const x = keypoints[i], y = keypoints[i + 1];
    if (Number.isFinite(x + y)) box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
  }
  const room = 0.1 * Math.max(box[2] - box[0], box[3] - box[1], 10);
  return [box[0] - room, box[1] - room, box[2] + room, box[3] + room];
})();

function drawImagePane(canvas, frame, showKeypoints, colours, redraw) {
  const { context, width, height } = prepared(canvas);
  const index = images && images.nearest(frame);
  const [x0, y0, x1, y1] = images ? images.boxes[index] : keypointsBox;
  if (!(x1 > x0)) return;
  const scale = Math.min(width / (x1 - x0), height / (y1 - y0));
  const left = (width - scale * (x1 - x0)) / 2, top = (height - scale * (y1 - y0)) / 2;
  let shown = frame;
  if (images) {
    // Keypoints are drawn on their own image, also where not every frame has one.
    shown = images.places[index];
    const image = images.decoded(index, redraw);
    if (image) context.drawImage(image, left, top, scale * (x1 - x0), scale * (y1 - y0));
  }
  if (!showKeypoints && images) return;
  const place = ([x, y]) => [left + scale * (x - x0), top + scale * (y - y0)];
  const thick = Math.max(2.5, 0.0085 * height);
  for (const body of bodies) {
    motion.parents.forEach((parent, joint) => {
      const b = keypointAt(shown, joint, body), a = parent < 0 ? b : keypointAt(shown, parent, body);
      if (known(a) && known(b)) {
        if (images) line(context, [place(a), place(b)], "rgb(0 0 0 / .45)", thick + 2.5);
        line(context, [place(a), place(b)], colours[motion.sides[joint]], thick);
      }
    });
    motion.joints.forEach((_, joint) => {
      const point = keypointAt(shown, joint, body);
      if (!known(point)) return;
      const [x, y] = place(point);
      context.fillStyle = "#fff";
      context.strokeStyle = colours[motion.sides[joint]];
      context.lineWidth = 1.5;
      context.beginPath();
      context.arc(x, y, thick * 0.75, 0, 2 * Math.PI);
      context.fill();
      context.stroke();
    });
    const head = keypointAt(shown, motion.joints.indexOf("head"), body);
    if (body.name && known(head)) named(context, body.name, place(head)[0], place(head)[1] - 3 * thick, "#fff");
  }
}
