// The service as this page speaks with it: the client of /client.js, and a form for the key where one is needed.

import { Client, ENDED, ServiceError } from "../client.js";

export { ENDED, ServiceError };

/** Raise an error; where a key is needed, the page that asks for it is opened, once. */
function refused(error) {
  if (error.status === 401 && !location.hash.startsWith("#/key")) location.hash = `#/key?back=${encodeURIComponent(location.hash)}`;
  throw error;
}

class PageClient extends Client {
  send(path, init) {
    return super.send(path, init).catch(refused);
  }

  upload(method, path, body, options) {
    return super.upload(method, path, body, options).catch(refused);
  }
}

export const service = new PageClient();

/**
 * Hide what the visitor's key may not do: elements with `data-needs`, a role. Where the service has no keys, all is shown.
 * Returns what the key may do; null: not known.
 */
export async function hideForbidden() {
  const own = await service.ownKey().catch(() => null);
  if (own) document.documentElement.dataset.role = own.role;
  return own;
}

/** Tell whether the service answers only those who have a key: this page itself has a cookie instead. */
export async function asksForKey() {
  return new Client().send("version", { credentials: "omit" }).then(() => false, error => error.status === 401);
}
