// The scene from above: where it was captured from, and the live camera's path.

const TRAIL = 3000;  // positions
const MARGIN = 0.12;

export class Plan {
  #canvas; #axes = null; #cameras = []; #trail = []; #here = null;

  constructor(canvas) {
    this.#canvas = canvas;
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#draw());
  }

  /** Show a scene, as the service describes it. */
  show(scene) {
    const matrices = (scene.training_cameras ?? []).map(camera => camera.world_from_camera);
    this.#axes = horizontal(scene.up_in_world, matrices);
    this.#cameras = matrices.map(matrix => this.#flat(column(matrix, 3)));
    this.#trail = [];
    this.#here = null;
    this.#draw();
  }

  /** The camera is here now. */
  move(matrix, status) {
    if (!this.#axes) return;
    const ahead = this.#flat(column(matrix, 2)), at = this.#flat(column(matrix, 3));
    this.#here = { at, angle: Math.atan2(ahead[1], ahead[0]), status };
    this.#trail.push(at);
    if (this.#trail.length > TRAIL) this.#trail.shift();
    this.#draw();
  }

  /** The camera isn't known to be anywhere: the trail is interrupted. */
  lose() {
    if (!this.#here) return;
    this.#here = null;
    this.#trail.push(null);
    this.#draw();
  }

  #flat(vector) {
    return this.#axes.map(axis => dot(axis, vector));
  }

  /** A colour of the style sheet for the theme that is shown: a canvas doesn't know light-dark(). */
  #colour(name) {
    this.#canvas.style.color = `var(${name})`;
    return getComputedStyle(this.#canvas).color;
  }

  #draw() {
    const context = this.#canvas.getContext("2d"), { width, height } = this.#canvas;
    const colour = name => this.#colour(name);
    const points = [...this.#cameras, ...this.#trail.filter(Boolean)];
    context.clearRect(0, 0, width, height);
    if (!points.length) return;
    const place = fitted(points, width, height);
    context.fillStyle = colour("--quiet");
    for (const point of this.#cameras) disc(context, place(point), 3);
    context.strokeStyle = colour("--accent");
    context.lineWidth = 2.5;
    context.beginPath();
    let joined = false;
    for (const point of this.#trail) {
      if (point) context[joined ? "lineTo" : "moveTo"](...place(point));
      joined = Boolean(point);
    }
    context.stroke();
    if (!this.#here) return;
    const [x, y] = place(this.#here.at), { angle, status } = this.#here;
    context.fillStyle = colour(status === "localized" ? "--good" : "--doubt");
    context.beginPath();  // what the camera sees, as a wedge
    context.moveTo(x, y);
    context.arc(x, y, 34, -angle - 0.5, -angle + 0.5);
    context.globalAlpha = 0.35;
    context.fill();
    context.globalAlpha = 1;
    disc(context, [x, y], 6);
  }
}

/** Two axes of the plane that is level: from the scene's up, else from what is up in its photos on average. */
function horizontal(up, matrices) {
  const sum = matrices.reduce((total, matrix) => total.map((value, i) => value - matrix[i][1]), [0, 0, 0]);
  const vertical = unit(up ?? (Math.hypot(...sum) > 1e-6 ? sum : [0, 1, 0]));
  const other = Math.abs(vertical[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
  const right = unit(other.map((value, i) => value - dot(other, vertical) * vertical[i]));
  return [right, cross(vertical, right)];
}

/** A function from points to pixels that shows all of these points, y upwards. */
function fitted(points, width, height) {
  const low = [0, 1].map(i => Math.min(...points.map(point => point[i])));
  const high = [0, 1].map(i => Math.max(...points.map(point => point[i])));
  const size = [0, 1].map(i => Math.max(high[i] - low[i], 1e-6));
  const scale = (1 - 2 * MARGIN) * Math.min(width / size[0], height / size[1]);
  return ([x, y]) => [width / 2 + scale * (x - (low[0] + high[0]) / 2), height / 2 - scale * (y - (low[1] + high[1]) / 2)];
}

function disc(context, [x, y], radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

const column = (matrix, index) => [0, 1, 2].map(row => matrix[row][index]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = vector => vector.map(value => value / Math.hypot(...vector));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
