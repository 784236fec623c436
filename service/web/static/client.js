// @ts-check
// A client of a splatfix service for browsers and Node 20: a module without dependencies, served at /client.js.
//
//   import { Client } from "https://service.example/client.js";
//   const { result } = await new Client("https://service.example", { key }).localize(file, { scene: "studio" });
//   console.log(result.status, result.pose.opengl.world_from_camera.matrix);
//
// Jobs, records and scenes are the documents of openapi.yaml as they are; the types below name what most callers read.

/**
 * @typedef {{matrix: number[][], translation: number[], quaternion_wxyz: number[]}} Transform  4x4, row by row
 * @typedef {{world_from_camera: Transform, camera_from_world: Transform}} Axes
 * @typedef {Axes & {position: number[], opengl: Axes}} Pose  OpenCV's camera axes; `opengl` has OpenGL's
 * @typedef {{model: string, width: number, height: number, fx: number, fy: number, cx: number, cy: number,
 *   distortion: number[]}} Intrinsics
 * @typedef {{matrix: number[][], sigma_deg: number, sigma_units: number}} Covariance
 * @typedef {{index: number, name: string, time_s: number, status: string, reason: string, score: number,
 *   world_from_camera: Transform, covariance: Covariance | null}} Frame
 * @typedef {{status: "localized" | "uncertain" | "not_localized", reason: string, hint: string, advice: string[],
 *   score: number, right_place: number | null, precise: number | null,
 *   pose: Pose, intrinsics: Intrinsics, covariance: Covariance | null, scene: {id: string}, frames: Frame[] | null,
 *   warnings: string[]}} Result
 * @typedef {{code: string, detail: string, where: string, hint: string, status: number}} Problem
 * @typedef {{id: string, state: string, scene: string, estimator: string, result: Result | null,
 *   error: Problem | null, links: Record<string, string>}} Job
 * @typedef {Job & {result: Result}} FinishedJob
 * @typedef {{index: number, stage: string, elapsed_s: number, world_from_camera: number[][],
 *   frame: Frame | null}} Step
 * @typedef {{id: string, name: string, state: string, uploaded: boolean, gaussians: number | null,
 *   cameras: number | null, memory_bytes: number | null, index: {views: number, planned_views: number} | null,
 *   error: Problem | null, links: Record<string, string>}} Scene
 * @typedef {{name: string, position: number[]}} Anchor
 * @typedef {{name: string | null, role: "read" | "localize" | "admin", scenes: string[] | null, rate: string | null,
 *   queue_share: number | null, expires: string | null}} OwnKey
 * @typedef {OwnKey & {name: string, created: string | null, expired: boolean, temporary: boolean}} Key
 * @typedef {object} Watch
 * @property {(step: Step) => void} [onRecord]  called with each step
 * @property {() => void} [onRestart]  the job is tried again: the steps before don't count any more
 * @property {(error: ServiceError) => void} [onLost]  the connection is lost, and tried again every second
 * @property {() => void} [onResumed]  and works again
 * @property {(share: number) => void} [onProgress]  called with the share of the photos that is sent, as in Upload
 * @property {AbortSignal} [signal]  ends the call with an AbortError; the job goes on
 * @typedef {object} Upload
 * @property {(share: number) => void} [onProgress]  called with the share that is sent, 0 to 1; outside of browsers,
 *   which alone can tell it, once, with 1
 * @property {AbortSignal} [signal]  ends the call with an AbortError
 */

/**
 * @typedef {{id: number, time_s: number, mode: "tracking" | "carried" | "relocalizing" | "lost",
 *   status: "localized" | "uncertain" | "not_localized", reason: string | null, score: number | null,
 *   world_from_camera: number[][] | null, covariance: number[][] | null, intrinsics: Intrinsics | null,
 *   world_from_odom: number[][] | null, units_per_odom: number | null, odom_covariance: number[][] | null,
 *   odom_offset_s: number | null, odom_resets: number | null,
 *   waited_ms: number, used_ms: number, dropped: number[]}} LiveAnswer
 * @typedef {{max_fps: number | null, long_side_px: number | null}} LiveHint
 * @typedef {object} LiveOptions
 * @property {Record<string, any>} [intrinsics]  of the frames, as for `localize`; estimated where there are none
 * @property {Record<string, any>} [prior]
 * @property {Record<string, any>} [accuracy]
 * @property {Record<string, any>} [odometry]  of the frames: metric, up_in_odom, up_sigma_deg, smooth
 * @property {(answer: LiveAnswer) => void} [onAnswer]
 * @property {(hint: LiveHint) => void} [onHint]  what had better be sent: frames a second, pixels of the long side
 * @property {(code: number, reason: string) => void} [onClose]  the session has ended; docs/live.md lists the codes
 */

/** States of a job that has ended. */
export const ENDED = ["succeeded", "failed", "cancelled", "interrupted"];
const JSON_TYPE = { "Content-Type": "application/json" };
const RETRY_MS = 1000;
const SILENT_MS = 45_000;  // three of the service's pings
const UNREACHABLE = { code: "unreachable", detail: "The service can't be reached.", hint: "Is it running?" };

/** The service answered with an error, doesn't answer, or a job ended without a result. */
export class ServiceError extends Error {
  /**
   * @param {Partial<Problem>} problem  an RFC 9457 document
   * @param {number} status  HTTP's; 0 where there was no answer
   * @param {number | null} [retryAfterS]
   */
  constructor(problem, status, retryAfterS = null) {
    super([problem.where && `${problem.where}:`, problem.detail, problem.hint].filter(Boolean).join(" "));
    this.name = "ServiceError";
    this.code = problem.code ?? "http_error";
    this.where = problem.where ?? "";
    this.hint = problem.hint ?? "";
    this.status = status;
    this.retryAfterS = retryAfterS;
  }
}

export class Client {
  /**
   * @param {string | URL} [url]  the service's address, with its sub-path; of a page's own service "."
   * @param {{key?: string}} [options]  an API key, where the service has keys and the page no session
   */
  constructor(url = ".", { key = "" } = {}) {
    const base = new URL(url, globalThis.document?.baseURI);
    if (!base.pathname.endsWith("/")) base.pathname += "/";
    this.base = base;
    /** @type {Record<string, string>} */
    this.headers = key.trim() ? { Authorization: `Bearer ${key.trim()}` } : {};
  }

  /**
   * Send a request below the service's address. Raises ServiceError.
   * @param {string} path  without a slash before it
   * @param {RequestInit} [init]
   */
  async send(path, init = {}) {
    let response;
    try {
      response = await fetch(new URL(path, this.base), { ...init, headers: { ...this.headers, ...init.headers } });
    } catch (error) {
      if (init.signal?.aborted) throw error;
      throw new ServiceError(UNREACHABLE, 0);
    }
    if (!response.ok) throw failed(parsed(await response.text().catch(() => "")), response.status, response.headers.get("Retry-After"));
    return response;
  }

  /**
   * The JSON that the service answers; null of an answer without any. Raises ServiceError.
   * @param {string} path
   * @param {RequestInit} [init]
   * @returns {Promise<any>}
   */
  async ask(path, init) {
    return (await this.send(path, init)).json().catch(() => null);
  }

  /**
   * Send a file or a form, and return the JSON that the service answers. Raises ServiceError.
   * @param {string} method
   * @param {string} path
   * @param {Blob | FormData} body
   * @param {Upload} [options]
   * @returns {Promise<any>}
   */
  async upload(method, path, body, { onProgress, signal } = {}) {
    if (onProgress && globalThis.XMLHttpRequest) return this.#uploadTold(method, path, body, onProgress, signal);
    const answer = await this.ask(path, { method, body, signal });
    onProgress?.(1);
    return answer;
  }

  /**
   * By XMLHttpRequest: fetch doesn't tell how much was sent.
   * @param {string} method
   * @param {string} path
   * @param {Blob | FormData} body
   * @param {(share: number) => void} onProgress
   * @param {AbortSignal} [signal]
   */
  #uploadTold(method, path, body, onProgress, signal) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest(), abort = () => request.abort();
      const end = (/** @type {() => void} */ settle) => () => { signal?.removeEventListener("abort", abort); settle(); };
      signal?.throwIfAborted();
      signal?.addEventListener("abort", abort);
      request.open(method, new URL(path, this.base));
      for (const [name, value] of Object.entries(this.headers)) request.setRequestHeader(name, value);
      request.upload.onprogress = ({ loaded, total }) => onProgress(total ? loaded / total : 1);
      request.onload = end(() => {
        const answer = parsed(request.responseText), { status } = request;
        status < 300 ? resolve(answer) : reject(failed(answer, status, request.getResponseHeader("Retry-After")));
      });
      request.onerror = end(() => reject(new ServiceError(UNREACHABLE, 0)));
      request.onabort = end(() => reject(signal?.reason ?? new DOMException("The upload was cancelled.", "AbortError")));
      request.send(body);
    });
  }

  /**
   * Localize a photo, a video, or several photos of one camera in their order; resolves to the job with its result. A
   * photo that is not localized is a result. Raises ServiceError.
   * @param {Blob | Blob[]} photos
   * @param {Record<string, any>} [fields]  of docs/api.md: scene, intrinsics, prior, gps, ...; objects are sent as JSON
   * @param {Watch} [watch]
   * @returns {Promise<FinishedJob>}
   */
  async localize(photos, fields = {}, watch = {}) {
    const job = await this.follow((await this.submit(photos, fields, watch)).id, watch);
    const { result } = job;
    if (!result) throw new ServiceError(job.error ?? { code: job.state, detail: `The job is ${job.state}.` }, job.error?.status ?? 0);
    return { ...job, result };
  }

  /**
   * Queue a job. A full queue is not tried again: see `retryAfterS` of the error.
   * @param {Blob | Blob[]} photos
   * @param {Record<string, any>} [fields]
   * @param {Upload} [options]
   * @returns {Promise<Job>}
   */
  submit(photos, fields = {}, { onProgress, signal } = {}) {
    const body = new FormData();
    for (const [name, value] of Object.entries(fields)) {
      if (value !== null && value !== undefined) body.append(name, typeof value === "string" ? value : JSON.stringify(value));
    }
    for (const photo of [photos].flat()) body.append("photo", photo, /** @type {File} */ (photo).name || "photo");
    return this.upload("POST", "localize", body, { onProgress, signal });
  }

  /**
   * Follow a job from its first step on; resolves to the ended job. A lost connection is taken up where it broke.
   * @param {string} id
   * @param {Watch} [watch]
   * @returns {Promise<Job>}
   */
  async follow(id, watch = {}) {
    const place = { lastId: "", lost: false };
    for (;;) {
      try {
        const job = await this.#stream(id, watch, place);
        if (job) return job;
        throw new ServiceError({ code: "unreachable", detail: "The stream of events ended before the job." }, 0);
      } catch (error) {
        if (!(error instanceof ServiceError) || (error.status > 0 && error.status < 500)) throw error;
        if (!place.lost) watch.onLost?.(error);
        place.lost = true;
        await pause(RETRY_MS, watch.signal);
      }
    }
  }

  /**
   * @param {string} id
   * @param {Watch} watch
   * @param {{lastId: string, lost: boolean}} place
   * @returns {Promise<Job | null>}
   */
  async #stream(id, watch, place) {
    const silence = new AbortController();
    const stop = () => silence.abort();
    watch.signal?.addEventListener("abort", stop);
    let timer = setTimeout(stop, SILENT_MS);
    try {
      const headers = place.lastId ? { "Last-Event-ID": place.lastId } : undefined;
      const response = await this.send(`jobs/${id}/events`, { headers, signal: silence.signal });
      if (place.lost) watch.onResumed?.();
      place.lost = false;
      for await (const event of events(response)) {
        clearTimeout(timer);
        timer = setTimeout(stop, SILENT_MS);
        place.lastId = event.id || place.lastId;
        if (event.name === "record") watch.onRecord?.(JSON.parse(event.data));
        else if (event.name === "restarted") watch.onRestart?.();
        else if (event.name === "result" || event.name === "error") return JSON.parse(event.data);
      }
      return null;
    } catch (error) {
      if (error instanceof ServiceError || error instanceof SyntaxError || watch.signal?.aborted) throw error;
      throw new ServiceError({ code: "unreachable", detail: "The connection to the service is lost." }, 0);
    } finally {
      clearTimeout(timer);
      watch.signal?.removeEventListener("abort", stop);
      silence.abort();
    }
  }

  /** @param {string} id @returns {Promise<Job>} */
  job(id) { return this.ask(jobPath(id)); }

  /** @param {Record<string, string | number>} [filters]  scene, state, status, limit, ... */
  async jobs(filters = {}) {
    const query = new URLSearchParams(Object.entries(filters).map(([name, value]) => [name, String(value)]));
    return /** @type {{jobs: Job[], next: string | null}} */ (await this.ask(`jobs?${query}`));
  }

  /** @param {string} id @returns {Promise<Job>} */
  cancel(id) { return this.ask(jobPath(id), { method: "DELETE" }); }

  /** Delete an ended job with its result and photo. @param {string} id */
  async deleteJob(id) { await this.send(`${jobPath(id)}?purge=true`, { method: "DELETE" }); }

  /** @param {string} id @param {"colmap" | "nerfstudio" | "tum" | "geopose"} format */
  async exported(id, format) { return (await this.send(`${jobPath(id)}/export/${format}`)).text(); }

  /** @returns {Promise<Scene[]>} */
  async scenes() { return (await this.ask("scenes")).scenes; }

  /**
   * A scene, with its training cameras where it is in memory.
   * @param {string} id
   * @returns {Promise<Scene & {training_cameras: any[], metres_per_unit: number | null}>}
   */
  scene(id) { return this.ask(scenePath(id)); }

  /**
   * Add a scene, which is checked, stored, and then loaded; for which, as for the next three, the key has the role admin.
   * @param {string} id
   * @param {Blob} file  a scene file, or a ZIP of a scene folder
   * @param {Upload & {name?: string}} [options]  `name`: that of the file, where it has none; its suffix is the format
   * @returns {Promise<Scene>}
   */
  uploadScene(id, file, { name = /** @type {File} */ (file).name || "scene.ply", ...options } = {}) {
    return this.upload("PUT", `${scenePath(id)}?file=${encodeURIComponent(name)}`, file, options);
  }

  /** Begin to load a scene into memory. @param {string} id @returns {Promise<Scene>} */
  loadScene(id) { return this.ask(`${scenePath(id)}/load`, { method: "POST" }); }

  /** Remove a scene from memory once its last job has ended. @param {string} id @returns {Promise<Scene>} */
  unloadScene(id) { return this.ask(`${scenePath(id)}/unload`, { method: "POST" }); }

  /** Delete an uploaded scene and its files. @param {string} id */
  async deleteScene(id) { await this.send(scenePath(id), { method: "DELETE" }); }

  /**
   * Resolve once photos can be localized in a scene. Raises ServiceError, also where it can't be loaded or isn't.
   * @param {string} id
   * @param {{signal?: AbortSignal}} [options]
   * @returns {Promise<Scene>}
   */
  async waitUntilReady(id, { signal } = {}) {
    for (;;) {
      const scene = await this.scene(id), { state, error } = scene;
      if (state === "ready") return scene;
      if (!["loading", "preparing"].includes(state)) {
        throw new ServiceError(error ?? { code: `scene_${state}`, detail: `Scene '${id}' is ${state}.`, hint: "Load it first." }, error?.status ?? 0);
      }
      await pause(RETRY_MS, signal);
    }
  }

  /**
   * An image of a scene from any pose, as a JPEG.
   * @param {string} id
   * @param {Record<string, any>} pose  as `prior` has it, e.g. {world_from_camera: [[...], ...]}
   * @param {Record<string, number>} [intrinsics]
   */
  async render(id, pose, intrinsics) {
    const body = JSON.stringify({ pose, intrinsics, format: "jpeg" });
    return (await this.send(`${scenePath(id)}/render`, { method: "POST", headers: JSON_TYPE, body })).blob();
  }

  /**
   * A scene's coverage map, or how far it is measured; `measure` begins that, for which the key has the role admin.
   * @param {string} id
   * @param {{measure?: boolean}} [options]
   */
  coverage(id, { measure = false } = {}) {
    return this.ask(`${scenePath(id)}/coverage`, { method: measure ? "POST" : "GET" });
  }

  /**
   * The most important Gaussians of a scene, in the binary form of `GET /scenes/{id}/splats`.
   * @param {string} id
   * @param {number} max
   * @returns {Promise<ArrayBuffer>}
   */
  async splats(id, max) { return (await this.send(`${scenePath(id)}/splats?max=${max}`)).arrayBuffer(); }

  /** End the measurement of a scene's coverage map; for which the key has the role admin. @param {string} id */
  cancelCoverage(id) { return this.ask(`${scenePath(id)}/coverage`, { method: "DELETE" }); }

  /** The named points of a scene. @param {string} id @returns {Promise<Anchor[]>} */
  async anchors(id) { return (await this.ask(`${scenePath(id)}/anchors`)).anchors; }

  /**
   * Add a named point to a scene, or move the one of that name; for which the key has the role admin.
   * @param {string} id
   * @param {string} name
   * @param {number[]} position  in the scene's world
   * @returns {Promise<Anchor>}
   */
  putAnchor(id, name, position) { return this.#put(anchorPath(id, name), { position }); }

  /** @param {string} id @param {string} name */
  async deleteAnchor(id, name) { await this.send(anchorPath(id, name), { method: "DELETE" }); }

  /**
   * Make a link that shows a job, read-only, to whoever has it.
   * @param {string} id
   * @param {{expiresInS?: number}} [options]  by default 7 days
   * @returns {Promise<{url: string, token: string, expires_in_s: number}>}
   */
  async share(id, { expiresInS } = {}) {
    const body = JSON.stringify({ expires_in_s: expiresInS });
    const made = await this.ask(`${jobPath(id)}/share`, { method: "POST", headers: JSON_TYPE, body });
    return { url: new URL(made.link, this.base).href, token: made.token, expires_in_s: made.expires_in_s };
  }

  /** What the key may do that requests are sent with. @returns {Promise<OwnKey>} */
  ownKey() { return this.ask("key"); }

  /** The keys of the service, for admins. @returns {Promise<Key[]>} */
  async keys() { return (await this.ask("keys")).keys; }

  /**
   * Make a key; the answer has it in `key`, this once.
   * @param {string} name
   * @param {Partial<Pick<Key, "role" | "scenes" | "rate" | "queue_share" | "expires">>} [what]
   * @returns {Promise<Key & {key: string}>}
   */
  addKey(name, what = {}) { return this.#put(`keys/${encodeURIComponent(name)}`, what); }

  /** Revoke a key, with its sessions and share links. @param {string} name */
  async removeKey(name) { await this.send(`keys/${encodeURIComponent(name)}`, { method: "DELETE" }); }

  /** @param {string} path @param {unknown} value */
  #put(path, value) { return this.ask(path, { method: "PUT", headers: JSON_TYPE, body: JSON.stringify(value) }); }

  /**
   * Begin a live session: a moving camera's frames go in, poses come out (docs/live.md). Rejects with a ServiceError
   * where it doesn't begin.
   * @param {string} scene
   * @param {LiveOptions} [options]
   * @returns {Promise<Live>}
   */
  async live(scene, options = {}) {
    const address = new URL(`${scenePath(scene)}/live`, this.base);
    address.protocol = address.protocol.replace("http", "ws");
    if (this.headers.Authorization) {  // no browser sends a header with a WebSocket
      address.searchParams.set("token", (await this.ask("tokens", { method: "POST" })).token);
    }
    const live = new Live(address, options);
    await live.began;
    return live;
  }
}

/** A live session; `Client.live` makes it. */
export class Live {
  #socket; #options; #nextId = 0; #open = /** @type {Set<number>} */ (new Set());

  /** @param {URL} address @param {LiveOptions} options */
  constructor(address, { intrinsics, prior, accuracy, odometry, ...options }) {
    const hello = { type: "hello", version: 1, intrinsics, prior, accuracy, odometry };
    this.#options = options;
    this.#socket = new WebSocket(address);
    this.#socket.binaryType = "arraybuffer";
    /** @type {Promise<void>} Resolves when frames may be sent. */
    this.began = new Promise((resolve, reject) => {
      this.#socket.onopen = () => this.#socket.send(JSON.stringify(hello));
      this.#socket.onmessage = event => this.#hear(JSON.parse(event.data), resolve);
      this.#socket.onclose = ({ code, reason }) => {
        reject(new ServiceError({ code: "live_closed", detail: `The live session ended (${code}). ${reason}`.trim() }, 0));
        this.#options.onClose?.(code, reason);
      };
    });
  }

  /** How many frames were sent whose answer, or loss, isn't known yet: send none while there are two. */
  get unanswered() { return this.#open.size; }

  /**
   * Send a frame; it may be dropped for a newer one.
   * @param {ArrayBuffer} jpeg
   * @param {number} timeS  when it was taken, by any clock
   * @param {number[]} [lens]  fx, fy, cx, cy of this frame, for lenses that change
   * @param {number[][]} [odomFromCamera]  a 4x4, by the device's odometry, OpenCV camera axes
   * @param {number[]} [upInCamera]  by gravity, OpenCV camera axes
   * @returns {number} its id
   */
  send(jpeg, timeS, lens, odomFromCamera, upInCamera) {
    const id = this.#nextId++;
    this.#open.add(id);
    this.#socket.send(liveMessage(id, timeS, jpeg, lens, odomFromCamera, upInCamera));
    return id;
  }

  /** End the session. */
  close() { this.#socket.close(1000); }

  /** @param {any} message @param {() => void} begin */
  #hear(message, begin) {
    if (message.type === "welcome") begin();
    else if (message.type === "hint") this.#options.onHint?.(message);
    else if (message.type === "answer") {
      for (const id of [message.id, ...message.dropped]) this.#open.delete(id);
      this.#options.onAnswer?.(message);
    }
  }
}

/**
 * The binary message of a frame: a header, and the JPEG.
 * @param {number} id
 * @param {number} timeS
 * @param {ArrayBuffer} jpeg
 * @param {number[]} [lens]  fx, fy, cx, cy
 * @param {number[][]} [odomFromCamera]  a 4x4
 * @param {number[]} [upInCamera]
 */
export function liveMessage(id, timeS, jpeg, lens, odomFromCamera, upInCamera) {
  const parts = [lens, odomFromCamera?.slice(0, 3).flat(), upInCamera], numbers = parts.flatMap(part => part ?? []);
  const length = 24 + 8 * numbers.length, message = new Uint8Array(length + jpeg.byteLength);
  const head = new DataView(message.buffer), flags = parts.reduce((sum, part, bit) => sum + (part ? 1 << bit : 0), 0);
  message.set([0x53, 0x46, 0x4c, 0x56, 1, flags]);  // SFLV, version, flags
  head.setUint16(6, length, true);
  head.setUint32(8, id, true);
  head.setFloat64(16, timeS, true);
  numbers.forEach((value, index) => head.setFloat64(24 + 8 * index, value, true));
  message.set(new Uint8Array(jpeg), length);
  return message;
}

/** @param {string} id */
const jobPath = id => `jobs/${encodeURIComponent(id)}`;
/** @param {string} id */
const scenePath = id => `scenes/${encodeURIComponent(id)}`;
/** @param {string} id @param {string} name */
const anchorPath = (id, name) => `${scenePath(id)}/anchors/${encodeURIComponent(name)}`;

/** The JSON of a text; null of any other. @param {string} text */
function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

/** @param {Partial<Problem> | null} problem @param {number} status @param {string | null} retryAfter */
function failed(problem, status, retryAfter) {
  return new ServiceError(problem ?? { detail: `The service answered HTTP ${status}.` }, status, Number(retryAfter) || null);
}

/**
 * The server-sent events of a response, as the HTML standard parses them; a comment is an event without a name.
 * @param {Response} response
 */
async function* events(response) {
  let rest = "", event = { name: "", id: "", data: "" };
  const reader = /** @type {ReadableStream<Uint8Array>} */ (response.body).getReader(), decoder = new TextDecoder();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const lines = (rest + decoder.decode(value, { stream: true })).split(/\r?\n/);
    rest = lines.pop() ?? "";
    for (const line of lines) {
      const [, field, text] = /** @type {RegExpMatchArray} */ (line.match(/^([^:]*):? ?(.*)$/));
      if (!line) {
        if (event.data) yield event;
        event = { name: "", id: "", data: "" };
      } else if (!field) yield { name: "", id: "", data: "" };
      else if (field === "event") event.name = text;
      else if (field === "id") event.id = text;
      else if (field === "data") event.data += (event.data && "\n") + text;
    }
  }
}

/** @param {number} milliseconds @param {AbortSignal} [signal] */
function pause(milliseconds, signal) {
  return /** @type {Promise<void>} */ (new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal?.addEventListener("abort", () => { clearTimeout(timer); reject(signal.reason); }, { once: true });
  }));
}
