// The API reference: Swagger UI over this server's own document. Asks nobody else.

window.SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#reference",
  presets: [window.SwaggerUIBundle.presets.apis],
  layout: "BaseLayout",
  deepLinking: true,
  validatorUrl: null,
  tryItOutEnabled: true,
});
