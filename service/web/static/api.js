// The API's description, drawn by Swagger UI.

/* global SwaggerUIBundle */

const page = document.querySelector("#swagger-ui");

// What Swagger UI draws of an opened operation has no names for a screen reader, and examples that no keyboard scrolls.
new MutationObserver(() => {
  for (const [selector, name] of [[".examples-select-element", "Example"], [".body-param__text", "Request body"]]) {
    for (const field of page.querySelectorAll(`${selector}:not([aria-label])`)) field.setAttribute("aria-label", name);
  }
  for (const row of page.querySelectorAll("[data-param-name], [data-property-name]")) {
    const { paramName, propertyName } = row.dataset;
    for (const field of row.querySelectorAll(":is(input, select, textarea):not([aria-label])")) field.setAttribute("aria-label", paramName ?? propertyName);
  }
  for (const example of page.querySelectorAll("pre.microlight:not([tabindex])")) example.tabIndex = 0;
}).observe(page, { childList: true, subtree: true });

// Links to single operations would be links inside of buttons, which a screen reader can't tell apart.
SwaggerUIBundle({ url: "openapi.json", dom_id: "#swagger-ui", deepLinking: false });
