// Files that the page makes itself: a button that saves one, and several in a ZIP.

import { h } from "./dom.js";

/** A button that saves what `content` returns, text or bytes, as a file. */
export function savingButton(name, content, label = "") {
  const button = h("button", { type: "button" }, label);
  button.addEventListener("click", () => {
    const link = h("a", { href: URL.createObjectURL(new Blob([content()], { type: "application/octet-stream" })), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  });
  return button;
}

/** The bytes of a ZIP of texts by their names, in ASCII; nothing is compressed (PKWARE's APPNOTE, 4.3). */
export function zip(texts) {
  const locals = [], central = [];
  let offset = 0;
  for (const [name, text] of Object.entries(texts)) {
    const [path, data] = [name, text].map(value => new TextEncoder().encode(value));
    // Version, flags, method (stored), time and date (1 January 1980), checksum, both sizes, length of the name.
    const facts = [[20, 2], [0, 2], [0, 2], [0, 2], [33, 2], [crc32(data), 4], [data.length, 4], [data.length, 4], [path.length, 2]];
    const local = [...packed([[0x04034b50, 4], ...facts, [0, 2]]), ...path];
    locals.push(new Uint8Array(local), data);
    central.push(...packed([[0x02014b50, 4], [20, 2], ...facts, [0, 2], [0, 2], [0, 2], [0, 2], [0, 4], [offset, 4]]), ...path);
    offset += local.length + data.length;
  }
  const count = Object.keys(texts).length;
  const end = packed([[0x06054b50, 4], [0, 2], [0, 2], [count, 2], [count, 2], [central.length, 4], [offset, 4], [0, 2]]);
  return new Blob([...locals, new Uint8Array([...central, ...end])]);
}

/** Numbers as bytes, the least significant first; each with its number of bytes. */
function packed(numbers) {
  return numbers.flatMap(([value, size]) => Array.from({ length: size }, (_, i) => (value >>> (8 * i)) & 255));
}

function crc32(bytes) {
  let crc = -1;
  for (const byte of bytes) {
    crc ^= byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}
