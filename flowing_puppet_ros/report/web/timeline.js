// SPDX-License-Identifier: Apache-2.0
// One slider moves everything that changes over time: the picture, the 3D view, and the marks in the plots.
'use strict';

class Timeline {
  constructor(root) {
    this.root = root;
    this.times = JSON.parse(root.querySelector('[data-times]').textContent);
    this.slider = root.querySelector('input[type=range]');
    this.button = root.querySelector('[data-play]');
    this.said = root.querySelector('output');
    this.pictures = [...root.querySelectorAll('.frame')];
    this.plots = [...root.querySelectorAll('svg[data-time]')];
    this.scene = this.makeScene();
    this.timer = 0;
    this.slider.addEventListener('input', () => { this.stop(); this.show(+this.slider.value); });
    this.button.addEventListener('click', () => this.timer ? this.stop() : this.play());
    for (const plot of this.plots) this.follow(plot);
    this.show(0);
  }

  makeScene() {
    const canvas = this.root.querySelector('canvas');
    if (!canvas) return null;
    try {
      const scene = new Scene(canvas, JSON.parse(this.root.querySelector('[data-scene]').textContent));
      for (const box of this.root.querySelectorAll('[data-shows]')) {
        box.addEventListener('change', () => { scene.shown[box.dataset.shows] = box.checked; scene.draw(); });
      }
      this.root.querySelector('[data-home]').addEventListener('click', () => { scene.home(); scene.draw(); });
      return scene;
    } catch (error) {
      // The still pictures further down show the bodies, too.
      this.root.querySelector('.space').hidden = true;
      this.root.querySelector('.no-space').hidden = false;
      return null;
    }
  }

  // The last of `seconds` that is not after `time`, or the first.
  static at(seconds, time) {
    let found = 0;
    for (let k = 0; k < seconds.length && seconds[k] <= time + 1e-6; k++) found = k;
    return found;
  }

  show(index) {
    const time = this.times[index];
    this.index = index;
    this.slider.value = index;
    this.said.textContent = `${time.toFixed(2)} s`;
    this.slider.setAttribute('aria-valuetext', this.said.textContent);
    if (this.pictures.length) {
      const shown = Timeline.at(this.pictures.map(picture => +picture.dataset.t), time);
      this.pictures.forEach((picture, k) => picture.classList.toggle('on', k === shown));
    }
    if (this.scene) {
      const frame = Timeline.at(this.scene.data.frames.map(one => one.t), time);
      if (frame !== this.scene.frame) this.scene.load(frame);
    }
    for (const plot of this.plots) {
      const [left, right, low, high] = plot.dataset.time.split(' ').map(Number);
      const x = left + (right - left) * Math.min(1, Math.max(0, (time - low) / (high - low)));
      const mark = plot.querySelector('.now');
      mark.setAttribute('x1', x);
      mark.setAttribute('x2', x);
    }
    this.root.dataset.frame = index;
  }

  // A press in a plot goes to its time.
  follow(plot) {
    const go = event => {
      const [left, right, low, high] = plot.dataset.time.split(' ').map(Number), box = plot.getBoundingClientRect();
      const x = (event.clientX - box.left) / box.width * plot.viewBox.baseVal.width;
      this.stop();
      this.show(Timeline.at(this.times, low + (high - low) * (x - left) / (right - left)));
    };
    plot.addEventListener('pointerdown', event => { plot.setPointerCapture(event.pointerId); go(event); });
    plot.addEventListener('pointermove', event => { if (event.buttons & 1) go(event); });
  }

  play() {
    this.button.textContent = 'Stop';
    const step = () => {
      const index = (this.index + 1) % this.times.length;
      const wait = index ? this.times[index] - this.times[index - 1] : 0.6;
      this.show(index);
      this.timer = setTimeout(step, Math.min(1000, Math.max(40, 1000 * wait)));
    };
    this.timer = setTimeout(step, 0);
  }

  stop() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.button.textContent = 'Play';
  }
}

for (const root of document.querySelectorAll('.timeline')) root.timeline = new Timeline(root);
