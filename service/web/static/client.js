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
 * @typedef {{id: string, name: string, state: string, gaussians: number | null, cameras: number | null}} Scene
 * @typedef {object} Watch
 * @property {(step: Step) => void} [onRecord]  called with each step
 * @property {() => void} [onRestart]  the job is tried again: the steps before don't count any more
 * @property {(error: ServiceError) => void} [onLost]  the connection is lost, and tried again every second
 * @property {() => void} [onResumed]  and works again
 * @property {AbortSignal} [signal]  ends the call with an AbortError; the job goes on
 */

/** States of a job that has ended. */
export const ENDED = ["succeeded", "failed", "cancelled", "interrupted"];
const RETRY_MS = 1000;
const SILENT_MS = 45_000;  // three of the service's pings

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
      throw new ServiceError({ code: "unreachable", detail: "The service can't be reached.", hint: "Is it running?" }, 0);
    }
    if (!response.ok) throw await failure(response);
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
   * Localize a photo, a video, or several photos of one camera in their order; resolves to the job with its result. A
   * photo that is not localized is a result. Raises ServiceError.
   * @param {Blob | Blob[]} photos
   * @param {Record<string, any>} [fields]  of docs/api.md: scene, intrinsics, prior, ...; objects are sent as JSON
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
   * @param {{signal?: AbortSignal}} [options]
   * @returns {Promise<Job>}
   */
  submit(photos, fields = {}, { signal } = {}) {
    const body = new FormData();
    for (const [name, value] of Object.entries(fields)) {
      if (value !== null && value !== undefined) body.append(name, typeof value === "string" ? value : JSON.stringify(value));
    }
    for (const photo of [photos].flat()) body.append("photo", photo, /** @type {File} */ (photo).name || "photo");
    return this.ask("localize", { method: "POST", body, signal });
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
  job(id) { return this.ask(`jobs/${encodeURIComponent(id)}`); }

  /** @param {Record<string, string | number>} [filters]  scene, state, status, limit, ... */
  async jobs(filters = {}) {
    const query = new URLSearchParams(Object.entries(filters).map(([name, value]) => [name, String(value)]));
    return /** @type {{jobs: Job[], next: string | null}} */ (await this.ask(`jobs?${query}`));
  }

  /** @param {string} id @returns {Promise<Job>} */
  cancel(id) { return this.ask(`jobs/${encodeURIComponent(id)}`, { method: "DELETE" }); }

  /** @param {string} id @param {"colmap" | "nerfstudio" | "tum" | "geopose"} format */
  async exported(id, format) { return (await this.send(`jobs/${encodeURIComponent(id)}/export/${format}`)).text(); }

  /** @returns {Promise<Scene[]>} */
  async scenes() { return (await this.ask("scenes")).scenes; }

  /** @param {string} id */
  scene(id) { return this.ask(`scenes/${encodeURIComponent(id)}`); }

  /**
   * An image of a scene from any pose, as a JPEG.
   * @param {string} id
   * @param {Record<string, any>} pose  as `prior` has it, e.g. {world_from_camera: [[...], ...]}
   * @param {Record<string, number>} [intrinsics]
   */
  async render(id, pose, intrinsics) {
    const headers = { "Content-Type": "application/json" };
    const body = JSON.stringify({ pose, intrinsics, format: "jpeg" });
    return (await this.send(`scenes/${encodeURIComponent(id)}/render`, { method: "POST", headers, body })).blob();
  }
}

/** @param {Response} response */
async function failure(response) {
  const problem = await response.json().catch(() => null);
  const after = Number(response.headers.get("Retry-After")) || null;
  return new ServiceError(problem ?? { detail: `The service answered HTTP ${response.status}.` }, response.status, after);
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
