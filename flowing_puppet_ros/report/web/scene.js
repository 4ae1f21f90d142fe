// SPDX-License-Identifier: Apache-2.0
// The 3D view: the fitted meshes and the points that they were fitted to, turned by mouse, touch or keys.
'use strict';

const VERTEX_SHADER = `#version 300 es
in vec3 place, normal, colour;
uniform mat4 view;
uniform float dot_size;
out vec3 shaded_normal, shade;
void main() {
  gl_Position = view * vec4(place, 1.0);
  gl_PointSize = dot_size;
  shaded_normal = normal;
  shade = colour;
}`;

// Light comes from the viewer's upper left; `lit` 0 leaves points and the floor as they are.
const FRAGMENT_SHADER = `#version 300 es
precision mediump float;
in vec3 shaded_normal, shade;
uniform vec3 light;
uniform float lit;
out vec4 pixel;
void main() {
  float amount = 0.42 + 0.58 * abs(dot(normalize(shaded_normal + vec3(1e-6)), light));
  pixel = vec4(shade * mix(1.0, amount, lit), 1.0);
}`;

const FIELD_OF_VIEW = 0.6, NEAR = 0.05, FAR = 200;

function bytes(text) {
  return Uint8Array.from(atob(text), letter => letter.charCodeAt(0)).buffer;
}

// Cross product, and a vector of length one.
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => a.map(value => value / (Math.hypot(...a) || 1));

class Scene {
  // `data` is what report_scene.py writes; `canvas` must have WebGL 2.
  constructor(canvas, data) {
    this.canvas = canvas;
    this.data = data;
    this.gl = canvas.getContext('webgl2', {antialias: true, preserveDrawingBuffer: true});
    if (!this.gl) throw new Error('no WebGL 2');
    this.faces = new Uint32Array(bytes(data.faces));
    this.colours = new Uint8Array(bytes(data.colours));
    this.shown = {mesh: true, points: true};
    this.frame = 0;
    this.home();
    this.prepare();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  home() {
    this.turn = this.data.azimuth + 0.5;
    this.tilt = 0.2;
    this.target = this.data.centre.slice();
    this.distance = this.data.size / (2 * Math.tan(FIELD_OF_VIEW / 2)) * 1.25;
  }

  prepare() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    this.program = program;
    this.buffers = {};
    this.floor = this.makeFloor();
    this.load(this.frame);
  }

  // Vertices in metres of whole numbers of a step.
  places(text) {
    const whole = new Int16Array(bytes(text)), {step, origin} = this.data;
    return Float32Array.from(whole, (value, index) => value * step + origin[index % 3]);
  }

  load(frame) {
    this.frame = frame;
    const {mesh, points, bodies} = this.data.frames[frame];
    this.mesh = {place: this.places(mesh), count: 0};
    const size = this.data.vertices;
    this.mesh.index = new Uint32Array(this.faces.length * bodies);
    this.mesh.colour = new Uint8Array(3 * size * bodies);
    for (let body = 0; body < bodies; body++) {
      this.mesh.index.set(this.faces.map(vertex => vertex + body * size), body * this.faces.length);
      this.mesh.colour.set(this.colours, 3 * body * size);
    }
    this.mesh.normal = this.normals(this.mesh.place, this.mesh.index);
    this.points = {place: this.places(points)};
    this.draw();
  }

  normals(place, index) {
    const normal = new Float32Array(place.length);
    for (let k = 0; k < index.length; k += 3) {
      const [a, b, c] = [3 * index[k], 3 * index[k + 1], 3 * index[k + 2]];
      const n = cross([0, 1, 2].map(i => place[b + i] - place[a + i]), [0, 1, 2].map(i => place[c + i] - place[a + i]));
      for (const corner of [a, b, c]) for (let i = 0; i < 3; i++) normal[corner + i] += n[i];
    }
    for (let k = 0; k < normal.length; k += 3) {
      const n = unit([normal[k], normal[k + 1], normal[k + 2]]);
      normal.set(n, k);
    }
    return normal;
  }

  makeFloor() {
    const {centre, floor, size} = this.data, place = [], half = Math.max(1, Math.ceil(size)), step = 0.5;
    const [x, y] = [Math.round(centre[0] / step) * step, Math.round(centre[1] / step) * step];
    for (let k = -half; k <= half; k += step) {
      place.push(x - half, y + k, floor, x + half, y + k, floor, x + k, y - half, floor, x + k, y + half, floor);
    }
    return {place: new Float32Array(place)};
  }

  // Right, up and back of the viewer in the scene.
  axes() {
    const back = [
      Math.cos(this.tilt) * Math.cos(this.turn), Math.cos(this.tilt) * Math.sin(this.turn), Math.sin(this.tilt),
    ];
    const right = unit(cross([0, 0, 1], back));
    return [right, cross(back, right), back];
  }

  matrix() {
    const [right, up, back] = this.axes(), aspect = this.canvas.width / Math.max(1, this.canvas.height);
    const eye = this.target.map((value, k) => value + back[k] * this.distance);
    const scale = 1 / Math.tan(FIELD_OF_VIEW / 2), wide = Math.min(1, aspect);
    const rows = [
      right.map(value => value * scale * wide / aspect), up.map(value => value * scale * wide), back.map(value => -value),
    ];
    const shift = rows.map(row => -row.reduce((sum, value, k) => sum + value * eye[k], 0));
    const [near, far] = [NEAR, FAR], a = (far + near) / (far - near), b = -2 * far * near / (far - near);
    const columns = [];
    for (let k = 0; k < 3; k++) columns.push(rows[0][k], rows[1][k], a * rows[2][k], rows[2][k]);
    columns.push(shift[0], shift[1], a * shift[2] + b, shift[2]);
    return columns;
  }

  fill(name, values, size, kind) {
    const gl = this.gl, place = gl.getAttribLocation(this.program, name);
    if (place < 0) return;
    this.buffers[name] ??= gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, kind, kind === gl.UNSIGNED_BYTE, 0, 0);
  }

  plain(name, values) {
    const place = this.gl.getAttribLocation(this.program, name);
    this.gl.disableVertexAttribArray(place);
    this.gl.vertexAttrib3f(place, ...values);
  }

  set(name, ...values) {
    this.gl[`uniform${values.length}f`](this.gl.getUniformLocation(this.program, name), ...values);
  }

  colour(name) {
    const text = getComputedStyle(this.canvas).getPropertyValue(name).trim().replace('#', '');
    const long = text.length === 3 ? [...text].map(letter => letter + letter).join('') : text;
    return [0, 2, 4].map(k => parseInt(long.slice(k, k + 2), 16) / 255);
  }

  draw() {
    const gl = this.gl, sharp = Math.min(2, window.devicePixelRatio || 1);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map(side => Math.round(side * sharp));
    if (!width || !height || gl.isContextLost()) return;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, {width, height});
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.colour('--card'), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.program, 'view'), false, this.matrix());
    const [right, up, back] = this.axes();
    this.set('light', ...unit(back.map((value, k) => value + 0.5 * up[k] - 0.4 * right[k])));
    this.set('dot_size', 2.4 * sharp);
    this.set('lit', 0);
    this.fill('place', this.floor.place, 3, gl.FLOAT);
    this.plain('normal', [0, 0, 1]);
    this.plain('colour', this.colour('--rule'));
    gl.drawArrays(gl.LINES, 0, this.floor.place.length / 3);
    if (this.shown.points && this.points.place.length) {
      this.fill('place', this.points.place, 3, gl.FLOAT);
      this.plain('colour', this.colour('--c0'));
      gl.drawArrays(gl.POINTS, 0, this.points.place.length / 3);
    }
    if (this.shown.mesh) this.drawMesh();
  }

  drawMesh() {
    const gl = this.gl;
    this.set('lit', 1);
    this.fill('place', this.mesh.place, 3, gl.FLOAT);
    this.fill('normal', this.mesh.normal, 3, gl.FLOAT);
    this.fill('colour', this.mesh.colour, 3, gl.UNSIGNED_BYTE);
    this.buffers.index ??= gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffers.index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, this.mesh.index, gl.DYNAMIC_DRAW);
    gl.drawElements(gl.TRIANGLES, this.mesh.index.length, gl.UNSIGNED_INT, 0);
  }

  rotate(x, y) {
    this.turn -= x;
    this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + y));
    this.draw();
  }

  pan(x, y) {
    const [right, up] = this.axes();
    this.target = this.target.map((value, k) => value - x * right[k] + y * up[k]);
    this.draw();
  }

  zoom(factor) {
    this.distance = Math.min(100, Math.max(0.3, this.distance * factor));
    this.draw();
  }

  // One finger or the left button turns, two fingers or another button move and zoom, and so does the wheel.
  listen() {
    const canvas = this.canvas, down = new Map();
    canvas.addEventListener('pointerdown', event => {
      down.set(event.pointerId, event);
      canvas.setPointerCapture(event.pointerId);
    });
    for (const end of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(end, event => down.delete(event.pointerId));
    }
    canvas.addEventListener('pointermove', event => {
      const before = down.get(event.pointerId);
      if (!before) return;
      const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
      const metres = this.distance / Math.max(1, canvas.clientHeight);
      const other = [...down.values()].find(one => one.pointerId !== event.pointerId);
      down.set(event.pointerId, event);
      if (other) {
        const apart = one => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
        this.zoom(apart(before) / apart(event));
        this.pan(x * metres / 2, y * metres / 2);
      } else if (event.buttons & 6 || event.shiftKey) this.pan(x * metres, y * metres);
      else this.rotate(x * 0.008, y * 0.008);
    });
    canvas.addEventListener('contextmenu', event => event.preventDefault());
    canvas.addEventListener('wheel', event => {
      event.preventDefault();
      this.zoom(Math.exp(Math.sign(event.deltaY) * 0.1));
    }, {passive: false});
    canvas.addEventListener('keydown', event => this.key(event));
    canvas.addEventListener('webglcontextlost', event => event.preventDefault());
    canvas.addEventListener('webglcontextrestored', () => this.prepare());
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }

  key(event) {
    const moves = {
      ArrowLeft: () => this.rotate(0.1, 0), ArrowRight: () => this.rotate(-0.1, 0),
      ArrowUp: () => this.rotate(0, 0.1), ArrowDown: () => this.rotate(0, -0.1),
      '+': () => this.zoom(0.9), '-': () => this.zoom(1 / 0.9), Home: () => { this.home(); this.draw(); },
    };
    if (!moves[event.key]) return;
    event.preventDefault();
    moves[event.key]();
  }
}
