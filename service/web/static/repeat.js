// Runs a job again: its photo, from this page or as the service keeps it, with the fields that it was sent with.

import { fieldsOf } from "./formats.js";
import { sendingBox, sendPhoto } from "./sending.js";
import { recalled } from "./sent.js";
import { service, ServiceError } from "./service.js";

/** Send a job's photo again, and show the new job. Raises ServiceError, also where the photo is gone. */
export async function repeat(id) {
  const job = await service.job(id);
  if (job.result?.frames) throw new ServiceError({ detail: "This job has several photos.", hint: "Send them again." }, 0);
  const { file, fields } = recalled(id) ?? await kept(job);
  const box = sendingBox(file.name);
  document.querySelector("#main").prepend(box.element);
  try {
    const again = await sendPhoto(file, fields, box.told, box.signal);
    location.hash = `#/jobs/${again.id}`;
  } catch (error) {
    if (error.name !== "AbortError") throw error;
  } finally {
    box.element.remove();
  }
}

/** The photo as the service keeps it: upright, undistorted, maybe reduced, hence with intrinsics of its own. */
async function kept(job) {
  const picture = await (await service.send(job.links.photo)).blob();
  const { model, width, height, fx, fy, cx, cy, distortion, trust } = job.photo.intrinsics;
  const intrinsics = JSON.stringify({ model, width, height, fx, fy, cx, cy, distortion, trust });
  return { file: new File([picture], job.photo.name || "photo.jpg", { type: "image/jpeg" }), fields: { ...fieldsOf(job), intrinsics } };
}
