// SPDX-License-Identifier: Apache-2.0
// The people of the image on show: editing with undo, saving on its own, outlines that follow.

import * as server from "./server.js";

const SAVE_AFTER = 250; // ms without a change
const RETRY_AFTER = 2000;

export class People {
  // `changed` is called when there is something new to draw, `say` with (text, whether it is a trouble).
  constructor(changed, say) {
    this.changed = changed;
    this.say = say;
    this.key = null;
    this.list = [];
    this.outlines = [];
    this.chosen = 0;
  }

  show(key, { revision, people }) {
    Object.assign(this, { key, revision, list: people, chosen: 0, undone: [], done: [], unsaved: false });
    this.outlines = people.map(() => null);
    this.asking = people.map(() => false);
    people.forEach((_, index) => this.follow(index));
  }

  get person() {
    return this.list[this.chosen];
  }

  // Call before a change; everything until the next call is one step of undo.
  remember() {
    this.done.push(JSON.stringify(this.list));
    this.undone = [];
  }

  touch(index) {
    this.unsaved = true;
    this.follow(index);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.save(), SAVE_AFTER);
    this.changed();
  }

  replace(list) {
    this.list = list;
    this.chosen = Math.max(0, Math.min(this.chosen, list.length - 1));
    this.outlines = list.map((_, index) => this.outlines[index] ?? null);
    this.asking = list.map(() => false);
    list.forEach((_, index) => this.touch(index));
    if (!list.length) this.touch(-1);
  }

  add(people) {
    this.remember();
    this.chosen = this.list.length;
    this.replace([...this.list, ...people]);
  }

  remove() {
    if (!this.person) return;
    this.remember();
    this.outlines.splice(this.chosen, 1);
    this.replace(this.list.filter((_, index) => index !== this.chosen));
  }

  step(from, to) {
    if (!from.length) return;
    to.push(JSON.stringify(this.list));
    this.outlines = [];
    this.replace(JSON.parse(from.pop()));
  }

  undo() {
    this.step(this.done, this.undone);
  }

  redo() {
    this.step(this.undone, this.done);
  }

  // Ask for the outline of a person; while one answer is awaited only the newest pose is kept waiting.
  async follow(index) {
    const person = this.list[index];
    if (!person) return;
    if (this.asking[index]) {
      this.asking[index] = "again";
      return;
    }
    const { key, asking } = this;
    asking[index] = true;
    try {
      const outline = await server.outline(person);
      if (this.key === key && this.asking === asking) this.outlines[index] = outline;
    } catch (error) {
      this.say(error.message, true);
    }
    const again = asking[index] === "again";
    asking[index] = false;
    this.changed();
    if (again && this.key === key && this.asking === asking) this.follow(index);
  }

  // Resolves when everything is on the disk, or when it cannot be said to be.
  async save(keepalive = false) {
    clearTimeout(this.timer);
    if (this.saving) await this.saving;
    if (!this.unsaved) return true;
    this.saving = this.send(keepalive);
    const fine = await this.saving;
    this.saving = null;
    return fine;
  }

  async send(keepalive) {
    const { key } = this;
    this.unsaved = false;
    try {
      const { revision } = await server.save(key, this.revision, this.list, keepalive);
      if (this.key === key) this.revision = revision;
      this.say("saved");
      return true;
    } catch (error) {
      if (error.status === 409) return this.yieldTo(key);
      this.unsaved = true;
      this.say(`not saved: ${error.message}`, true);
      if (error.status === 0 || error.status >= 500) this.timer = setTimeout(() => this.save(), RETRY_AFTER);
      return false;
    }
  }

  // Somebody else saved first: show theirs; ours is one undo away.
  async yieldTo(key) {
    const { revision, people } = await server.annotation(key);
    if (this.key !== key) return false;
    this.remember();
    Object.assign(this, { revision, list: people, chosen: 0, outlines: people.map(() => null) });
    this.asking = people.map(() => false);
    people.forEach((_, index) => this.follow(index));
    this.say("changed in another window: that version is shown, undo brings yours back", true);
    this.changed();
    return true;
  }

  // Another window may have changed the image while this one was not looked at.
  async refresh() {
    const { key } = this;
    if (!key || this.unsaved || this.saving) return;
    const { revision } = await server.revision(key);
    if (revision !== this.revision && this.key === key && !this.unsaved) await this.yieldTo(key);
  }
}
