// node make_ksplat.mjs IN.ply OUT.ksplat COMPRESSION_LEVEL SH_DEGREE: by the viewer's own writer; see make.sh.
import fs from "fs";
globalThis.window = globalThis;
const { PlyLoader } = await import("@mkkellogg/gaussian-splats-3d");
const [, , from, to, level, degree] = process.argv;
const ply = fs.readFileSync(from);
const bytes = ply.buffer.slice(ply.byteOffset, ply.byteOffset + ply.byteLength);
const buffer = await PlyLoader.loadFromFileData(bytes, 0, Number(level), true, Number(degree));
fs.writeFileSync(to, Buffer.from(buffer.bufferData));
