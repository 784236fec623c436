// Photo and render on top of one another, under a slider.

import { h } from "./dom.js";

/** Return an element with both pictures and `share(value)`, which sets the render's share, 0 to 1.
 * `file` is the photo's own file, where this page has sent it: shown when the service has deleted its copy. */
export function blend(photo, render, alt, file = null) {
  const below = h("img", { src: photo, alt: "The photo", class: "below" });
  const above = h("img", { src: render, alt, class: "above" });
  const note = h("figcaption", { class: "quiet" });
  const figure = h("figure", { class: "blend" }, h("div", { class: "stack" }, below, above), note);
  const gone = () => {
    below.remove();
    above.classList.add("alone");
    note.textContent = "The photo was deleted after the job.";
  };
  below.addEventListener("error", () => {
    if (!file) return gone();
    below.addEventListener("error", gone, { once: true });
    below.src = URL.createObjectURL(file);
  }, { once: true });
  above.addEventListener("error", () => {
    above.remove();
    note.textContent = "No render available.";
  });
  return { element: figure, share: value => { above.style.opacity = value; } };
}

/** Return a slider from photo to render that moves all the given blends. */
export function blendSlider(blends) {
  const slider = h("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": "Share of the render" });
  const move = () => {
    slider.setAttribute("aria-valuetext", `${slider.value} % render`);
    blends.forEach(one => one.share(slider.value / 100));
  };
  slider.addEventListener("input", move);
  move();
  const end = (name, value) => {
    const button = h("button", { type: "button", class: "plain" }, name);
    button.addEventListener("click", () => { slider.value = value; move(); });
    return button;
  };
  return h("div", { class: "slide" }, end("Photo", 0), slider, end("Render", 100));
}
