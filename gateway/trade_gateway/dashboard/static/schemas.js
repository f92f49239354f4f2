// The services, and the types of their arguments and results.

import { gateway } from "./gateway.js";

export let services = [];
let described = { paths: {}, components: { schemas: {} } };

/** Fetch all of it again. */
export async function lookForServices() {
  [services, described] = await Promise.all([gateway.get("/services"), gateway.get("/openapi.json")]);
}

export function resolve(schema) {
  const name = schema?.$ref?.split("/").at(-1);
  return name ? resolve(described.components.schemas[name]) : schema;
}

export const operationOf = (one) => described.paths[`/call/${one.group}/${one.name}`]?.post;
