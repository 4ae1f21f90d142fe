// SPDX-License-Identifier: Apache-2.0
// Draws the image with its puppets, and turns pointers into changes of the view and of the people.

const REACH = 14; // css pixels around a joint that belong to it
const MOST_ZOOM = 40;
const colour = ([r, g, b], alpha = 1) => `rgba(${r},${g},${b},${alpha})`;

export class Canvas {
  constructor(element, people, folder) {
    Object.assign(this, { element, people, folder, image: null, size: [1, 1], hidden: false, joint: null });
    this.at = { x: 0, y: 0, zoom: 1 };
    this.pointers = new Map();
    this.context = element.getContext("2d");
    new ResizeObserver(() => this.resize()).observe(element);
    for (const name of ["down", "move", "up", "cancel"])
      element.addEventListener(`pointer${name}`, (event) => this[name](event));
    element.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
  }

  show(image, size) {
    Object.assign(this, { image, size, joint: null });
    this.fit();
  }

  resize() {
    const ratio = devicePixelRatio;
    this.element.width = Math.round(this.element.clientWidth * ratio);
    this.element.height = Math.round(this.element.clientHeight * ratio);
    this.fit();
  }

  fit() {
    const { clientWidth: w, clientHeight: h } = this.element;
    const zoom = Math.min(w / this.size[0], h / this.size[1]) * 0.97;
    this.at = { zoom, x: (w - zoom * this.size[0]) / 2, y: (h - zoom * this.size[1]) / 2 };
    this.draw();
  }

  // Pixel (0, 0) is the centre of the first pixel.
  toScreen([x, y]) {
    return [(x + 0.5) * this.at.zoom + this.at.x, (y + 0.5) * this.at.zoom + this.at.y];
  }

  toImage([x, y]) {
    return [(x - this.at.x) / this.at.zoom - 0.5, (y - this.at.y) / this.at.zoom - 0.5];
  }

  zoomBy(factor, [x, y] = [this.element.clientWidth / 2, this.element.clientHeight / 2]) {
    const zoom = Math.min(MOST_ZOOM, Math.max(0.02, this.at.zoom * factor));
    const ratio = zoom / this.at.zoom;
    this.at = { zoom, x: x - (x - this.at.x) * ratio, y: y - (y - this.at.y) * ratio };
    this.draw();
  }

  place(event) {
    const box = this.element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  wheel(event) {
    event.preventDefault();
    this.zoomBy(Math.exp(-event.deltaY * 0.0015), this.place(event));
  }

  nearestJoint(point) {
    let best = null;
    this.people.list.forEach((person, index) =>
      person.joints.forEach((joint, number) => {
        const [x, y] = this.toScreen(joint);
        const distance = Math.hypot(x - point[0], y - point[1]) - (index === this.people.chosen ? 3 : 0);
        if (distance < REACH && (!best || distance < best.distance)) best = { index, number, distance };
      }),
    );
    return best;
  }

  personUnder(point) {
    const at = this.toImage(point);
    const found = this.people.outlines.findIndex((outline) =>
      outline?.parts.some(({ contour }) => this.context.isPointInPath(path([at[0], at[1]], contour), 0, 0)),
    );
    return found < 0 ? null : found;
  }

  down(event) {
    this.element.setPointerCapture(event.pointerId);
    const point = this.place(event);
    this.pointers.set(event.pointerId, point);
    this.grip = this.pointers.size > 1 ? { kind: "pinch" } : this.gripAt(point);
    this.draw();
  }

  gripAt(point) {
    const joint = this.nearestJoint(point);
    if (joint) {
      this.people.chosen = joint.index;
      return { kind: "joint", ...joint };
    }
    const person = this.personUnder(point);
    if (person === null) return { kind: "image" };
    this.people.chosen = person;
    return { kind: "person", index: person };
  }

  move(event) {
    const point = this.place(event);
    const before = this.pointers.get(event.pointerId);
    if (!before) {
      const joint = this.nearestJoint(point);
      if (joint?.number !== this.joint?.number || joint?.index !== this.joint?.index) {
        this.joint = joint;
        this.draw();
      }
      return;
    }
    if (this.grip.kind === "pinch") this.pinch(event.pointerId, point);
    else this.drag(point, before);
    this.pointers.set(event.pointerId, point);
  }

  pinch(id, point) {
    const other = [...this.pointers].find(([key]) => key !== id)?.[1];
    if (!other) return;
    const before = this.pointers.get(id);
    const spread = (a) => Math.max(1, Math.hypot(a[0] - other[0], a[1] - other[1]));
    this.at.x += (point[0] - before[0]) / 2;
    this.at.y += (point[1] - before[1]) / 2;
    this.zoomBy(spread(point) / spread(before), [(point[0] + other[0]) / 2, (point[1] + other[1]) / 2]);
  }

  drag(point, before) {
    const { kind, index, number } = this.grip;
    if (kind === "image") {
      this.at.x += point[0] - before[0];
      this.at.y += point[1] - before[1];
      this.draw();
      return;
    }
    if (!this.grip.moved) this.people.remember();
    this.grip.moved = true;
    const [from, to] = [this.toImage(before), this.toImage(point)];
    const { joints } = this.people.list[index];
    for (const joint of kind === "joint" ? [joints[number]] : joints) {
      joint[0] += to[0] - from[0];
      joint[1] += to[1] - from[1];
    }
    this.people.touch(index);
  }

  up(event) {
    this.pointers.delete(event.pointerId);
    // A finger that stays after a pinch must not drag what lies under it.
    this.grip = this.pointers.size ? { kind: "image" } : null;
    this.draw();
  }

  cancel(event) {
    this.up(event);
  }

  draw() {
    const { context, element, at } = this;
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, element.clientWidth, element.clientHeight);
    if (!this.image) return;
    context.imageSmoothingEnabled = at.zoom < 3;
    context.drawImage(this.image, at.x, at.y, this.size[0] * at.zoom, this.size[1] * at.zoom);
    if (this.hidden) return;
    this.people.list.forEach((person, index) => {
      const chosen = index === this.people.chosen;
      this.drawOutline(this.people.outlines[index], chosen);
      this.drawSkeleton(person, chosen);
    });
  }

  drawOutline(outline, chosen) {
    const { context } = this;
    for (const { part, contour } of outline?.parts ?? []) {
      context.beginPath();
      contour.forEach((point) => context.lineTo(...this.toScreen(point)));
      context.closePath();
      context.fillStyle = colour(this.folder.part_colours[part], chosen ? 0.28 : 0.15);
      context.fill();
      context.lineWidth = chosen ? 2 : 1;
      context.strokeStyle = colour(this.folder.part_colours[part], chosen ? 1 : 0.6);
      context.stroke();
    }
  }

  drawSkeleton(person, chosen) {
    const { context, folder } = this;
    context.lineWidth = 1.5;
    context.strokeStyle = `rgba(255,255,255,${chosen ? 0.8 : 0.4})`;
    for (const [a, b] of folder.bones) {
      context.beginPath();
      context.moveTo(...this.toScreen(person.joints[a]));
      context.lineTo(...this.toScreen(person.joints[b]));
      context.stroke();
    }
    person.joints.forEach((joint, number) => {
      const [x, y] = this.toScreen(joint);
      context.beginPath();
      context.arc(x, y, chosen ? 6 : 4, 0, 2 * Math.PI);
      context.fillStyle = colour(folder.joint_colours[number], joint[2] ? 0.9 : 0);
      context.fill();
      context.lineWidth = 2;
      context.strokeStyle = joint[2] ? "#000" : colour(folder.joint_colours[number]);
      context.stroke();
    });
    if (chosen && this.joint) this.drawName();
  }

  drawName() {
    const { index, number } = this.joint;
    const joint = this.people.list[index]?.joints[number];
    if (!joint) return;
    const [x, y] = this.toScreen(joint);
    const text = this.folder.joint_names[number].replace("_", " ");
    this.context.font = "13px system-ui, sans-serif";
    this.context.lineWidth = 3;
    this.context.strokeStyle = "#000";
    this.context.strokeText(text, x + 10, y - 8);
    this.context.fillStyle = "#fff";
    this.context.fillText(text, x + 10, y - 8);
  }
}

// A path of the contour with `origin` moved to (0, 0): isPointInPath ignores no transformation of the context then.
function path([x, y], contour) {
  const shape = new Path2D();
  contour.forEach(([a, b]) => shape.lineTo(a - x, b - y));
  shape.closePath();
  return shape;
}
