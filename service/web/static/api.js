// The service as this page speaks with it: JSON, problem documents, server-sent events.

export class Problem extends Error {
  /** `body` is an RFC 9457 document, or null where the service did not answer with one. */
  constructor(body, status) {
    const parts = body ? [body.where && `${body.where}:`, body.detail, body.hint] : [`The service answered ${status}.`];
    super(parts.filter(Boolean).join(" "));
    this.body = body;
    this.status = status;
  }
}

const UNREACHABLE = { detail: "The service can't be reached.", hint: "Is it running?" };

/** Return the error of an answer; where a key is needed, the page that asks for it is opened, once. */
function refused(body, status) {
  if (status === 401 && !location.hash.startsWith("#/key")) location.hash = `#/key?back=${encodeURIComponent(location.hash)}`;
  return new Problem(body, status);
}

/** Return the service's answer. Raises Problem. */
export async function send(path, init) {
  let response;
  try {
    response = await fetch(path, init);
  } catch {
    throw new Problem(UNREACHABLE, 0);
  }
  if (!response.ok) throw refused(await response.json().catch(() => null), response.status);
  return response;
}

export async function ask(path, init) {
  return (await send(path, init)).json().catch(() => null);
}

/** Tell whether the service answers only those who have a key: this page itself has a cookie instead. */
export async function asksForKey() {
  return fetch("version", { credentials: "omit" }).then(response => response.status === 401, () => false);
}

export const ENDED = ["succeeded", "failed", "cancelled", "interrupted"];

const AGAIN_MS = 1000;

/**
 * Follow a job: `onRecord` for each step, `onRestart` when the records before don't count any more, `onEnd` with the
 * ended job once. Where the connection is lost, `onLost` is called, and it is tried again every second until it is back
 * (`onBack`) or the service refuses for good (`onRefused` with the Problem). Returns a function that stops it.
 *
 * EventSource's own way back ends at the first answer that is no stream, as a proxy gives while the service starts.
 */
export function follow(job, { onRecord, onRestart, onEnd, onLost, onBack, onRefused }) {
  let source = null, timer = null, lost = false, ended = false;
  const again = async () => {
    source.close();
    if (ended) return;
    if (!lost) onLost();
    lost = true;
    try {
      await ask(job.links.self);
    } catch (error) {
      if ([401, 403, 404].includes(error.status)) return onRefused(error);
    }
    if (!ended) timer = setTimeout(open, AGAIN_MS);
  };
  const open = () => {
    source = new EventSource(job.links.events);
    source.addEventListener("open", () => {
      if (!lost) return;
      lost = false;
      onRestart();  // the stream begins again with the first record
      onBack();
    });
    source.addEventListener("record", event => onRecord(JSON.parse(event.data)));
    source.addEventListener("restarted", onRestart);
    for (const name of ["result", "error"]) {
      source.addEventListener(name, event => {
        if (event.data === undefined) return again();  // the connection's own error
        ended = true;
        source.close();
        onEnd(JSON.parse(event.data));
      });
    }
  };
  open();
  return () => { ended = true; clearTimeout(timer); source.close(); };
}

/** Send a form; `onProgress` gets the sent share, 0 to 1. Raises Problem; `signal` aborts it. */
export function upload(path, form, onProgress, signal) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();  // fetch doesn't tell how much was sent
    const refuse = problem => reject(refused(problem, request.status));
    request.open("POST", path);
    request.responseType = "json";
    request.upload.addEventListener("progress", event => onProgress(event.loaded / event.total));
    request.addEventListener("load", () => (request.status < 300 ? resolve(request.response) : refuse(request.response)));
    request.addEventListener("error", () => refuse(UNREACHABLE));
    request.addEventListener("abort", () => reject(new DOMException("The upload was cancelled.", "AbortError")));
    signal?.addEventListener("abort", () => request.abort());
    request.send(form);
  });
}
