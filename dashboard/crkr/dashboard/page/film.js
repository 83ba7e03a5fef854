"use strict";
// Plays the trials of the page's film with WebGL: shapes on bodies, and the paths of points.
(() => {
  const numbers = (text) => new Float32Array(Uint8Array.from(atob(text), (one) => one.charCodeAt(0)).buffer);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;

  // Triangles with normals of each kind of shape, by half sizes or radius and half length.
  const grid = (across, along, at) => {
    const out = [];
    const put = (i, j) => out.push(...at((i / across) * 2 * Math.PI, j / along));
    for (let i = 0; i < across; i++)
      for (let j = 0; j < along; j++)
        for (const [a, b] of [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]]) put(i + a, j + b);
    return out;
  };
  const ball = (sx, sy, sz, lift = 0) => grid(20, 14, (turn, share) => {
    const down = Math.PI * share, [x, y, z] = [Math.sin(down) * Math.cos(turn), Math.sin(down) * Math.sin(turn), Math.cos(down)];
    const tall = Math.abs(z) < 1e-9 ? 0 : Math.sign(z) * lift;
    return [sx * x, sy * y, sz * z + tall, x, y, z];
  });
  const shapes = {
    sphere: ([r]) => ball(r, r, r),
    capsule: ([r, half]) => ball(r, r, r, half).concat(grid(20, 1, (turn, share) => {
      const [x, y] = [Math.cos(turn), Math.sin(turn)];
      return [r * x, r * y, half * (1 - 2 * share), x, y, 0];
    })),
    cylinder: ([r, half]) => grid(28, 3, (turn, share) => {
      const [x, y] = [Math.cos(turn), Math.sin(turn)], level = Math.round(3 * share);
      const side = level === 1 || level === 2, up = level < 2 ? 1 : -1;
      return [(level % 3 ? r : 0) * x, (level % 3 ? r : 0) * y, half * up, side ? x * .7 : 0, side ? y * .7 : 0, side ? .7 * up : up];
    }),
    box: (half) => {
      const out = [];
      for (let axis = 0; axis < 3; axis++) for (const sign of [-1, 1]) {
        const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
        for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
          const at = [0, 0, 0], normal = [0, 0, 0];
          at[axis] = sign * half[axis]; at[u] = a * half[u]; at[v] = b * half[v]; normal[axis] = sign;
          out.push(...at, ...normal);
        }
      }
      return out;
    },
  };
  const turned = ([x, y, z, w], [a, b, c]) => {
    const [tx, ty, tz] = [2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)];
    return [a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx];
  };

  const vertex = `attribute vec3 at, normal; uniform mat4 view; uniform vec3 move; uniform vec4 turn; varying vec3 facing;
    vec3 spin(vec3 v) { return v + 2. * cross(turn.xyz, cross(turn.xyz, v) + turn.w * v); }
    void main() { facing = spin(normal); gl_Position = view * vec4(spin(at) + move, 1.); }`;
  const fragment = `precision mediump float; uniform vec4 colour; uniform float flat_; varying vec3 facing;
    void main() { vec3 n = normalize(facing + vec3(1e-5)); float light = .52 + .34 * max(dot(n, normalize(vec3(.4, -.5, .9))), 0.) + .16 * n.z;
      gl_FragColor = vec4(colour.rgb * mix(light, 1., flat_), colour.a); }`;

  const program = (gl) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    gl.useProgram(made);
    return made;
  };

  class Player {
    constructor(canvas, scene, trial) {
      this.canvas = canvas;
      this.trial = trial;
      this.poses = numbers(trial.poses);
      this.paths = Object.values(trial.paths).map(numbers);
      this.end = trial.time[trial.time.length - 1];
      this.clock = 0;
      this.playing = !still;
      const gl = (this.gl = canvas.getContext("webgl", { antialias: true, alpha: true }));
      if (!gl) throw new Error("no WebGL");
      const made = program(gl);
      this.at = (name) => gl.getUniformLocation(made, name);
      this.in = (name) => gl.getAttribLocation(made, name);
      this.parts = scene.filter((geom) => shapes[geom.shape]).map((geom) => this.part(geom));
      this.line = gl.createBuffer();
      gl.enable(gl.DEPTH_TEST);
      gl.enable(gl.BLEND);
      gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      this.frame(scene);
    }
    part(geom) {
      const { gl } = this, raw = shapes[geom.shape](geom.size), data = new Float32Array(raw.length);
      for (let i = 0; i < raw.length; i += 6) {
        const at = turned(geom.turn, raw.slice(i, i + 3));
        data.set([at[0] + geom.at[0], at[1] + geom.at[1], at[2] + geom.at[2]], i);
        data.set(turned(geom.turn, raw.slice(i + 3, i + 6)), i + 3);
      }
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      return { buffer, count: data.length / 6, body: this.trial.bodies.indexOf(geom.body), colour: geom.colour };
    }
    // What moves, and the shapes near it, fill the picture.
    frame(scene) {
      const low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
      const take = (x, y, z, r = 0) => [x, y, z].forEach((value, i) => {
        low[i] = Math.min(low[i], value - r);
        high[i] = Math.max(high[i], value + r);
      });
      const { bodies } = this.trial, on = bodies.map((body) => scene.filter((geom) => geom.body === body));
      for (let i = 0; i < this.poses.length; i += 7) {
        const [x, y, z, ...turn] = this.poses.slice(i, i + 7);
        take(x, y, z, 0.05);
        for (const geom of on[(i / 7) % bodies.length]) {
          const at = turned(turn, geom.at);
          take(x + at[0], y + at[1], z + at[2], Math.min(...geom.size.filter((half) => half > 0)));
        }
      }
      for (const path of this.paths) for (let i = 0; i < path.length; i += 3) take(path[i], path[i + 1], path[i + 2]);
      const span = Math.max(...high.map((value, i) => value - low[i]), 0.2);
      for (const geom of scene) {
        const size = Math.max(...geom.size);
        if (this.trial.bodies.indexOf(geom.body) < 0 && size < span) take(...geom.at, size / 2);
      }
      this.centre = low.map((value, i) => (value + high[i]) / 2);
      this.far = Math.max(0.62 * Math.hypot(...high.map((value, i) => value - low[i])), 0.3) * 1.28;
      const flat = high[2] - low[2] < 0.15 * span;
      [this.around, this.above] = [-1.05, flat ? 1.35 : 0.42];
      this.fit();
      const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((place) => [0, 1, 2].map((i) => (place >> i & 1 ? high : low)[i]));
      for (let tries = 0; tries < 12; tries++) { // perspective makes what is near larger
        const m = this.view(), at = (p, row) => m[row] * p[0] + m[4 + row] * p[1] + m[8 + row] * p[2] + m[12 + row];
        if (corners.every((p) => Math.max(Math.abs(at(p, 0)), Math.abs(at(p, 1))) < 0.96 * at(p, 3))) break;
        this.far *= 1.08;
      }
    }
    fit() {
      const { canvas } = this, dense = Math.min(devicePixelRatio || 1, 2);
      const [wide, tall] = [Math.round(canvas.clientWidth * dense), Math.round(canvas.clientHeight * dense)];
      if (canvas.width !== wide || canvas.height !== tall) [canvas.width, canvas.height] = [wide, tall];
      return [wide, tall];
    }
    view() {
      const { canvas } = this, aspect = canvas.width / canvas.height, near = this.far * 0.05, deep = this.far * 20;
      const [ca, sa, ce, se] = [Math.cos(this.around), Math.sin(this.around), Math.cos(this.above), Math.sin(this.above)];
      const back = [ce * ca, ce * sa, se], right = [-sa, ca, 0], up = [-se * ca, -se * sa, ce];
      const eye = this.centre.map((value, i) => value + back[i] * this.far);
      const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2], zoom = 2.1 * Math.min(1, aspect);
      const rows = [right.map((v) => v * zoom / aspect), up.map((v) => v * zoom)];
      const [k, l] = [(near + deep) / (near - deep), 2 * near * deep / (near - deep)], out = [];
      for (let i = 0; i < 3; i++) out.push(rows[0][i], rows[1][i], k * back[i], -back[i]);
      out.push(-dot(rows[0], eye), -dot(rows[1], eye), -k * dot(back, eye) + l, dot(back, eye));
      return out;
    }
    pose(body, step, share) {
      const n = this.trial.bodies.length, a = (step * n + body) * 7, b = a + (step + 1 < this.trial.time.length ? n * 7 : 0), p = this.poses;
      const mix = (i, sign = 1) => p[a + i] + (sign * p[b + i] - p[a + i]) * share;
      const sign = p[a + 3] * p[b + 3] + p[a + 4] * p[b + 4] + p[a + 5] * p[b + 5] + p[a + 6] * p[b + 6] < 0 ? -1 : 1;
      const turn = [mix(3, sign), mix(4, sign), mix(5, sign), mix(6, sign)], size = Math.hypot(...turn) || 1;
      return [[mix(0), mix(1), mix(2)], turn.map((value) => value / size)];
    }
    // A path as a band that faces the reader.
    ribbon(path) {
      const out = new Float32Array(2 * path.length), n = path.length / 3, wide = this.far * 0.0035;
      const [ca, sa, ce, se] = [Math.cos(this.around), Math.sin(this.around), Math.cos(this.above), Math.sin(this.above)];
      const back = [ce * ca, ce * sa, se];
      for (let i = 0; i < n; i++) {
        const [a, b] = [3 * Math.max(i - 1, 0), 3 * Math.min(i + 1, n - 1)], way = [0, 1, 2].map((k) => path[b + k] - path[a + k]);
        const side = [way[1] * back[2] - way[2] * back[1], way[2] * back[0] - way[0] * back[2], way[0] * back[1] - way[1] * back[0]];
        const size = wide / (Math.hypot(...side) || 1);
        for (let k = 0; k < 3; k++) {
          out[6 * i + k] = path[3 * i + k] + side[k] * size;
          out[6 * i + 3 + k] = path[3 * i + k] - side[k] * size;
        }
      }
      return out;
    }
    draw() {
      const { gl, trial } = this, [wide, tall] = this.fit();
      gl.viewport(0, 0, wide, tall);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.uniformMatrix4fv(this.at("view"), false, this.view());
      let step = 0;
      while (step + 1 < trial.time.length && trial.time[step + 1] <= this.clock) step++;
      const next = trial.time[step + 1], share = next === undefined ? 0 : (this.clock - trial.time[step]) / (next - trial.time[step] || 1);
      gl.enableVertexAttribArray(this.in("at"));
      gl.enableVertexAttribArray(this.in("normal"));
      gl.uniform1f(this.at("flat_"), 0);
      for (const part of this.parts.slice().sort((a, b) => b.colour[3] - a.colour[3])) {
        const [move, turn] = part.body < 0 ? [[0, 0, 0], [0, 0, 0, 1]] : this.pose(part.body, step, share);
        gl.bindBuffer(gl.ARRAY_BUFFER, part.buffer);
        gl.vertexAttribPointer(this.in("at"), 3, gl.FLOAT, false, 24, 0);
        gl.vertexAttribPointer(this.in("normal"), 3, gl.FLOAT, false, 24, 12);
        gl.uniform3fv(this.at("move"), move);
        gl.uniform4fv(this.at("turn"), turn);
        gl.uniform4fv(this.at("colour"), part.colour);
        gl.drawArrays(gl.TRIANGLES, 0, part.count);
      }
      gl.uniform3fv(this.at("move"), [0, 0, 0]);
      gl.uniform4fv(this.at("turn"), [0, 0, 0, 1]);
      gl.uniform1f(this.at("flat_"), 1);
      gl.disableVertexAttribArray(this.in("normal"));
      for (const path of this.paths) {
        gl.bindBuffer(gl.ARRAY_BUFFER, this.line);
        gl.bufferData(gl.ARRAY_BUFFER, this.ribbon(path), gl.DYNAMIC_DRAW);
        gl.vertexAttribPointer(this.in("at"), 3, gl.FLOAT, false, 12, 0);
        for (const [count, strength] of [[2 * path.length / 3, 0.3], [2 * step + 2, 1]]) {
          gl.uniform4fv(this.at("colour"), trial.good ? [0.1, 0.68, 0.62, strength] : [0.95, 0.45, 0.12, strength]);
          gl.drawArrays(gl.TRIANGLE_STRIP, 0, count);
        }
      }
    }
  }

  let players = [];
  const begin = () => {
    const data = document.getElementById("film-data");
    players = [];
    if (!data) return;
    const { scene, trials } = JSON.parse(data.textContent);
    for (const canvas of document.querySelectorAll("canvas.film")) {
      const place = Number(canvas.dataset.trial), find = (what) => document.querySelector(`[data-${what}="${place}"]`);
      let player;
      try {
        player = new Player(canvas, scene, trials[place]);
      } catch {
        canvas.replaceWith("This browser draws no 3D pictures.");
        continue;
      }
      const [button, seek, shown] = [find("play"), find("seek"), find("clock")];
      const slower = player.trial.slower > 1 ? `, ${player.trial.slower} times slower` : "";
      const name = () => { button.textContent = player.playing ? "Pause" : "Play"; };
      button.addEventListener("click", () => { player.playing = !player.playing; name(); });
      seek.addEventListener("input", () => { player.playing = false; player.clock = player.end * seek.value / 1000; player.stale = true; name(); });
      player.told = () => { seek.value = 1000 * player.clock / (player.end || 1); shown.textContent = `${player.clock.toFixed(2)} s${slower}`; };
      player.seen = true;
      new IntersectionObserver(([entry]) => { player.seen = entry.isIntersecting; }).observe(canvas);
      let held = null;
      canvas.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
      canvas.addEventListener("pointerup", () => { held = null; });
      canvas.addEventListener("pointercancel", () => { held = null; });
      canvas.addEventListener("pointermove", (event) => {
        if (!held) return;
        player.around -= (event.clientX - held[0]) * 0.01;
        player.above = Math.min(1.55, Math.max(-0.4, player.above + (event.clientY - held[1]) * 0.008));
        held = [event.clientX, event.clientY];
        player.stale = true;
      });
      canvas.addEventListener("wheel", (event) => {
        if (!event.ctrlKey) return;
        event.preventDefault();
        player.far *= Math.exp(event.deltaY * 0.01);
        player.stale = true;
      }, { passive: false });
      name();
      players.push(player);
    }
  };
  let before = 0;
  const tick = (now) => {
    requestAnimationFrame(tick);
    const passed = Math.min((now - before) / 1000, 0.1);
    if (passed < 0.03) return; // 30 pictures a second are enough
    before = now;
    for (const player of players) {
      const moves = player.playing || player.stale || player.canvas.width !== player.shownWidth;
      if (!player.seen || !moves) continue;
      const step = passed / player.trial.slower, pause = 0.8 / player.trial.slower;
      if (player.playing) player.clock = player.clock + step > player.end + pause ? 0 : player.clock + step;
      const clock = player.clock;
      player.clock = Math.min(clock, player.end);
      player.told();
      player.draw();
      [player.clock, player.stale, player.shownWidth] = [clock, false, player.canvas.width];
    }
  };
  document.addEventListener("film", begin);
  begin();
  requestAnimationFrame(tick);
})();
