// SPDX-License-Identifier: Apache-2.0
// The annotation page: the list of images, the buttons and the keys.

import { Canvas } from "./canvas.js";
import { People } from "./people.js";
import * as server from "./server.js";

const $ = (id) => document.getElementById(id);
const SCALE_STEP = 1.03;

function say(text, bad = false) {
  $("state").textContent = text;
  $("state").classList.toggle("bad", bad);
}

const folder = await server.folder();
const people = new People(redraw, say);
const canvas = new Canvas($("canvas"), people, folder);
const rows = folder.items.map((key) => Object.assign(document.createElement("li"), { textContent: key, title: key }));
let place = -1;
let turn = 0;

function redraw() {
  canvas.draw();
  const { person } = people;
  $("gender").disabled = $("view").disabled = !person;
  if (person) [$("gender").value, $("view").value] = [person.gender, person.view];
  if (place >= 0) count(folder.items[place], people.list.length);
}

function count(key, number) {
  if (number) folder.counts[key] = number;
  else delete folder.counts[key];
  rows[folder.items.indexOf(key)].classList.toggle("done", number > 0);
  const done = folder.items.filter((item) => folder.counts[item]).length;
  $("progress").textContent = `${done} of ${folder.items.length} done`;
}

// Only the last of several quick choices is shown.
async function show(next) {
  if (next < 0 || next >= folder.items.length || next === place) return;
  const mine = ++turn;
  const key = folder.items[next];
  if (!(await people.save()) || mine !== turn) return;
  try {
    const [annotation, image] = await Promise.all([server.annotation(key), server.picture(key)]);
    if (mine !== turn) return;
    rows[place]?.classList.remove("now");
    place = next;
    rows[place].classList.add("now");
    rows[place].scrollIntoView({ block: "nearest" });
    location.hash = encodeURIComponent(key);
    people.show(key, annotation);
    canvas.show(image, annotation.size);
    say("");
    redraw();
  } catch (error) {
    if (mine === turn) say(error.message, true);
  }
}

function todo() {
  const after = folder.items.findIndex((key, index) => index > place && !folder.counts[key]);
  const any = folder.items.findIndex((key) => !folder.counts[key]);
  if (any < 0) say("every image is done");
  else show(after < 0 ? any : after);
}

async function add(ask) {
  const { key } = people;
  say("one moment ...");
  try {
    const found = await ask();
    if (people.key !== key) return;
    say("");
    people.add(found);
  } catch (error) {
    say(error.message, true);
  }
}

function change(edit) {
  if (!people.person) return;
  people.remember();
  edit(people.person);
  people.touch(people.chosen);
}

function rescale(factor) {
  change(({ joints }) => {
    const mean = [0, 1].map((axis) => joints.reduce((sum, joint) => sum + joint[axis], 0) / joints.length);
    for (const joint of joints) for (const axis of [0, 1]) joint[axis] = mean[axis] + factor * (joint[axis] - mean[axis]);
  });
}

const following = (list, value) => list[(list.indexOf(value) + 1) % list.length];

const deeds = {
  previous: () => show(place - 1),
  next: () => show(place + 1),
  todo,
  add: () => add(async () => [await server.newPerson(people.key, $("gender").value, $("view").value)]),
  find: () => add(async () => (await server.find(people.key)).people),
  copy: () => add(async () => (await server.carry(people.key)).people),
  remove: () => people.remove(),
  undo: () => people.undo(),
  redo: () => people.redo(),
  fit: () => canvas.fit(),
  help: () => $("help").showModal(),
  choose: () => {
    people.chosen = (people.chosen + 1) % Math.max(1, people.list.length);
    redraw();
  },
  smaller: () => rescale(1 / SCALE_STEP),
  larger: () => rescale(SCALE_STEP),
  seen: () => {
    const { joint } = canvas;
    if (!joint || !people.list[joint.index]) return;
    people.remember();
    const place = people.list[joint.index].joints[joint.number];
    place[2] = 1 - place[2];
    people.touch(joint.index);
  },
  flip: () => change((person) => (person.view = following(folder.views, person.view))),
  gender: () => change((person) => (person.gender = following(folder.genders, person.gender))),
  in: () => canvas.zoomBy(1.25),
  out: () => canvas.zoomBy(0.8),
};

const KEYS = {
  ArrowLeft: "previous", ArrowRight: "next", n: "todo", a: "add", p: "find", c: "copy", Delete: "remove", Backspace: "remove",
  Tab: "choose", "[": "smaller", "]": "larger", v: "seen", f: "flip", g: "gender", "+": "in", "=": "in", "-": "out",
  0: "fit", "?": "help",
};

document.addEventListener("keydown", (event) => {
  if ($("help").open || event.target.tagName === "SELECT") return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  let deed = KEYS[key];
  if (event.ctrlKey || event.metaKey) deed = { z: event.shiftKey ? "redo" : "undo", y: "redo" }[key];
  if (key === "h" && !event.repeat) hide(true);
  // Tab walks through the controls unless the picture has the focus.
  if (!deed || event.altKey || (deed === "choose" && document.activeElement !== $("canvas"))) return;
  event.preventDefault();
  deeds[deed]();
});
document.addEventListener("keyup", (event) => event.key.toLowerCase() === "h" && hide(false));

function hide(hidden) {
  canvas.hidden = hidden;
  canvas.draw();
}

for (const button of document.querySelectorAll("[data-do]"))
  button.addEventListener("click", () => {
    deeds[button.dataset.do]();
    $("canvas").focus();
  });
for (const [id, values] of [["gender", folder.genders], ["view", folder.views]]) {
  $(id).append(...values.map((value) => new Option(value, value)));
  $(id).addEventListener("change", (event) => change((person) => (person[id] = event.target.value)));
}
rows.forEach((row, index) => row.addEventListener("click", () => show(index)));
$("items").append(...rows);
$("name").textContent = folder.name;
folder.items.forEach((key) => folder.counts[key] && count(key, folder.counts[key]));
window.addEventListener("focus", () => people.refresh().catch((error) => say(error.message, true)));
window.addEventListener("pagehide", () => people.save(true));
window.addEventListener("beforeunload", (event) => people.unsaved && event.preventDefault());
const first = folder.items.indexOf(decodeURIComponent(location.hash.slice(1)));
await show(Math.max(0, first));
document.body.dataset.ready = "yes";
