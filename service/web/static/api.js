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

/** Return the service's answer. Raises Problem. */
export async function send(path, init) {
  let response;
  try {
    response = await fetch(path, init);
  } catch {
    throw new Problem({ detail: "The service can't be reached.", hint: "Is it running?" }, 0);
  }
  if (!response.ok) throw new Problem(await response.json().catch(() => null), response.status);
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

/**
 * Follow a job: `onRecord` for each step, `onRestart` when it is tried again and the records before don't count any
 * more, `onEnd` with the ended job once. Returns a function that stops it.
 */
export function follow(job, { onRecord, onRestart, onEnd, onTrouble }) {
  const source = new EventSource(job.links.events);
  source.addEventListener("record", event => onRecord(JSON.parse(event.data)));
  source.addEventListener("restarted", onRestart);
  for (const name of ["result", "error"]) {
    source.addEventListener(name, event => {
      if (event.data === undefined) {  // the connection's own error; the browser connects again unless refused
        onTrouble(source.readyState === EventSource.CLOSED);
        return;
      }
      source.close();
      onEnd(JSON.parse(event.data));
    });
  }
  return () => source.close();
}
