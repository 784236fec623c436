// The service as this page speaks with it: the client of /client.js, a form for the key where one is needed, and uploads
// that tell how much is sent.

import { Client, ENDED, ServiceError } from "../client.js";

export { ENDED, ServiceError };

const UNREACHABLE = { code: "unreachable", detail: "The service can't be reached.", hint: "Is it running?" };

/** Return an error; where a key is needed, the page that asks for it is opened, once. */
function refused(error) {
  if (error.status === 401 && !location.hash.startsWith("#/key")) location.hash = `#/key?back=${encodeURIComponent(location.hash)}`;
  return error;
}

class PageClient extends Client {
  async send(path, init) {
    try {
      return await super.send(path, init);
    } catch (error) {
      throw refused(error);
    }
  }

  /** Send a form or a file; `onProgress` gets the sent share, 0 to 1. Raises ServiceError; `signal` aborts it. */
  upload(method, path, body, onProgress, signal) {
    return new Promise((resolve, reject) => {
      const request = new XMLHttpRequest();  // fetch doesn't tell how much was sent
      const refuse = problem => reject(refused(new ServiceError(problem ?? { detail: `The service answered HTTP ${request.status}.` }, request.status)));
      request.open(method, new URL(path, this.base));
      request.responseType = "json";
      request.upload.addEventListener("progress", event => onProgress(event.loaded / event.total));
      request.addEventListener("load", () => (request.status < 300 ? resolve(request.response) : refuse(request.response)));
      request.addEventListener("error", () => refuse(UNREACHABLE));
      request.addEventListener("abort", () => reject(new DOMException("The upload was cancelled.", "AbortError")));
      signal?.addEventListener("abort", () => request.abort());
      request.send(body);
    });
  }
}

export const service = new PageClient();

/**
 * Hide what the visitor's key may not do: elements with `data-needs`, a role. Where the service has no keys, all is shown.
 * Returns what the key may do; null: not known.
 */
export async function hideForbidden() {
  const own = await fetch("key").then(answer => (answer.ok ? answer.json() : null), () => null);
  if (own) document.documentElement.dataset.role = own.role;
  return own;
}

/** Tell whether the service answers only those who have a key: this page itself has a cookie instead. */
export async function asksForKey() {
  return fetch("version", { credentials: "omit" }).then(response => response.status === 401, () => false);
}
