// What this page has sent itself: the photo's file and fields of a job. Forgotten with the tab.

const KEEP = 20;
const sent = new Map();

export function remember(id, file, fields) {
  sent.set(id, { file, fields });
  for (const old of [...sent.keys()].slice(0, -KEEP)) sent.delete(old);
}

export function recalled(id) {
  return sent.get(id) ?? null;
}
