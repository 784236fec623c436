// The API's description, drawn by Swagger UI.

/* global SwaggerUIBundle */

// Links to single operations would be links inside of buttons, which a screen reader can't tell apart.
SwaggerUIBundle({ url: "openapi.json", dom_id: "#swagger-ui", deepLinking: false });
