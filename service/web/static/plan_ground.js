// A scene's Gaussians seen from above, in grey, cut open above the cameras: what a plan is drawn on.

const GAUSSIANS = 30000;
const SIGMAS = 1.5;  // radius of an ellipse in standard deviations
const ABOVE = 0.15;  // of the plan's extent: how far above the cameras the cut is
const MIN_OPACITY = 77;  // of 255: fainter ones are haze and floaters
const INNER = [0.05, 0.95];  // quantiles of the positions that a plan without anything else spans

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class PlanGround {
  #points; #key = ""; #href = null;

  constructor(points) {
    this.#points = points;
  }

  /** Ask for a scene's Gaussians, to be seen along the third of the axes. */
  static async of(service, id, axes) {
    return new PlanGround(flattened(await service.splats(id, GAUSSIANS), axes));
  }

  /** Two opposite corners of the middle of the scene; none of an empty scene. */
  get corners() {
    if (!this.#points.length) return [];
    const at = (k, share) => quantile(this.#points.map(p => p[k]), share);
    return INNER.map(share => ({ x: at("x", share), y: at("y", share) }));
  }

  /** A picture (data URL) of the plan between bounds, of as many pixels; `eye`: height of the cameras, null: not known. */
  picture([[left, right], [bottom, top]], width, eye) {
    const key = [left, right, bottom, top, width, eye].join();
    if (key === this.#key) return this.#href;
    const canvas = document.createElement("canvas"), scale = width / (right - left);
    [canvas.width, canvas.height] = [Math.round(width), Math.round((top - bottom) * scale)];
    const context = canvas.getContext("2d");
    const cut = eye === null
      ? quantile(this.#points.map(p => p.height), 0.5)
      : eye + ABOVE * Math.max(right - left, top - bottom);
    for (const p of this.#points) {
      if (p.height > cut) continue;
      context.fillStyle = p.grey;
      context.beginPath();
      context.ellipse((p.x - left) * scale, (top - p.y) * scale, p.major * scale, p.minor * scale, -p.angle, 0, 2 * Math.PI);
      context.fill();
    }
    this.#key = key;
    this.#href = canvas.toDataURL();
    return this.#href;
  }
}

/** The ellipses of the opaque Gaussians in the plan, the lowest first, from the layout of `GET /scenes/{id}/splats`. */
function flattened(buffer, [first, second, up]) {
  const start = 4 + new DataView(buffer).getUint32(0, true);
  const { count } = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, start - 4)));
  const centres = new Float32Array(buffer, start, 3 * count), spreads = new Float32Array(buffer, start + 12 * count, 6 * count);
  const colours = new Uint8Array(buffer, start + 36 * count, 4 * count);
  const points = [];
  for (let i = 0; i < count; i++) {
    const [red, green, blue, opacity] = colours.subarray(4 * i, 4 * i + 4);
    if (opacity < MIN_OPACITY) continue;
    const at = centres.subarray(3 * i, 3 * i + 3), grey = Math.round(0.3 * red + 0.59 * green + 0.11 * blue);
    const [xx, xy, xz, yy, yz, zz] = spreads.subarray(6 * i, 6 * i + 6);
    const times = v => [xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]];
    const a = dot(first, times(first)), b = dot(first, times(second)), c = dot(second, times(second));
    // Eigenvalues of the symmetric 2 x 2 matrix (a b; b c).
    const middle = (a + c) / 2, apart = Math.hypot((a - c) / 2, b);
    points.push({
      x: dot(first, at), y: dot(second, at), height: dot(up, at), angle: 0.5 * Math.atan2(2 * b, a - c),
      major: SIGMAS * Math.sqrt(middle + apart), minor: SIGMAS * Math.sqrt(Math.max(middle - apart, 0)),
      grey: `rgb(${grey} ${grey} ${grey} / ${(opacity / 255).toFixed(2)})`,
    });
  }
  return points.sort((a, b) => a.height - b.height);
}

function quantile(values, share) {
  const sorted = values.toSorted((a, b) => a - b);
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : 0;
}
