// SPDX-License-Identifier: Apache-2.0
// Requests to the annotation server.

export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

async function ask(method, path, body, more = {}) {
  let answer;
  try {
    answer = await fetch(path, {
      method,
      headers: body === undefined ? {} : { "Content-Type": "application/json" },
      body: body === undefined ? undefined : JSON.stringify(body),
      ...more,
    });
  } catch {
    throw new Refused(0, "the annotation server does not answer; is it still running?");
  }
  const data = await answer.json();
  if (!answer.ok) throw new Refused(answer.status, data.error);
  return data;
}

const named = (path, key) => `${path}?key=${encodeURIComponent(key)}`;

export const folder = () => ask("GET", "/api/folder");
export const annotation = (key) => ask("GET", named("/api/annotation", key));
export const revision = (key) => ask("GET", named("/api/revision", key));
export const save = (key, revision, people, keepalive) =>
  ask("PUT", "/api/annotation", { key, revision, people }, { keepalive });
export const outline = (person) => ask("POST", "/api/outline", { person });
export const newPerson = (key, gender, view) => ask("POST", "/api/new", { key, gender, view });
export const find = (key) => ask("POST", "/api/find", { key });
export const carry = (key) => ask("POST", "/api/carry", { key });

export async function picture(key) {
  const image = new Image();
  image.src = named("/api/image", key);
  try {
    await image.decode();
  } catch {
    // The server says why; an image element does not.
    const answer = await fetch(image.src);
    throw new Refused(answer.status, answer.ok ? "the browser cannot show this image" : (await answer.json()).error);
  }
  return image;
}
