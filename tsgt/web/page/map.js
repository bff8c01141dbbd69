// The map: stations, sight lines, fences, trail and robot, seen from above. The x axis of the frame, the zero of station 1's
// circle, is up ("north up"), or the robot's heading.

const LENGTHS_M = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];
const MIN_SCALE = 0.05, MAX_SCALE = 400; // pixels per metre

export class MissionMap {
  constructor(canvas) {
    this.canvas = canvas;
    this.setup = null;
    this.view = null;
    this.trail = [];
    this.last = null; // the last valid pose, kept when there is none
    this.stale = true;
    this.follow = true;
    this.north = true;
    this.scale = 8;
    this.centre = [0, 0];
    this.fitted = false;
    this.pointers = new Map();
    this.onMove = () => {};
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2); }, { passive: false });
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); this.pointers.set(event.pointerId, [event.clientX, event.clientY]); });
    canvas.addEventListener("pointermove", (event) => this.dragged(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
  }

  dragged(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const ratio = Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.hypot(before[0] - other[0], before[1] - other[1]);
      if (Number.isFinite(ratio) && ratio > 0) this.zoom(ratio);
    } else {
      this.pan(now[0] - before[0], now[1] - before[1]);
    }
    this.pointers.set(event.pointerId, now);
  }

  pan(right, down) {
    this.follow = false;
    const [c, s] = this.rotation();
    const u = -right / this.scale, v = down / this.scale; // right and up, in m on the screen
    this.centre = [this.centre[0] + v * c - u * s, this.centre[1] - v * s - u * c];
    this.onMove();
    this.draw();
  }

  zoom(ratio) {
    this.scale = Math.min(Math.max(this.scale * ratio, MIN_SCALE), MAX_SCALE);
    this.fitted = true;
    this.draw();
  }

  // Cosine and sine of the angle by which the world is turned on the screen.
  rotation() {
    const heading = !this.north && this.last ? this.last.heading_rad : 0;
    return [Math.cos(heading), -Math.sin(heading)];
  }

  // Stations, trail and robot, and the fences as well if asked for: beside a large fence all else would be too small.
  fit(fences = true) {
    const points = this.trail.filter((point) => point);
    if (this.setup) {
      for (const station of this.setup.stations) points.push(station.at);
      if (fences) for (const fence of this.setup.fences) points.push(...fence.polygon);
    }
    if (this.last) points.push(this.last.at);
    if (!points.length) return;
    if (this.follow && this.last) for (const [x, y] of [...points]) points.push([2 * this.last.at[0] - x, 2 * this.last.at[1] - y]);
    const xs = points.map((point) => point[0]), ys = points.map((point) => point[1]);
    const low = [Math.min(...xs), Math.min(...ys)], high = [Math.max(...xs), Math.max(...ys)];
    this.centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    const width = this.canvas.clientWidth - 80, height = this.canvas.clientHeight - 110;
    const tall = this.north ? high[0] - low[0] : Math.hypot(high[0] - low[0], high[1] - low[1]);
    const wide = this.north ? high[1] - low[1] : tall;
    this.scale = Math.min(Math.max(Math.min(width / Math.max(wide, 4), height / Math.max(tall, 4)), MIN_SCALE), MAX_SCALE);
    this.fitted = !this.follow || Boolean(this.last); // again with the first valid pose
    this.draw();
  }

  update(view, stale) {
    this.view = view;
    this.stale = stale;
    if (view && view.pose && view.pose.valid) this.last = view.pose;
    if (!this.fitted && this.setup && (this.last || this.trail.length)) this.fit(false);
    this.draw();
  }

  // Pixels of a point of the frame.
  at(point) {
    const x = point[0] - this.centre[0], y = point[1] - this.centre[1];
    const [c, s] = this.rotation();
    return [this.middle[0] + this.scale * -(s * x + c * y), this.middle[1] - this.scale * (c * x - s * y)];
  }

  draw() {
    const canvas = this.canvas, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = colour("back");
    pen.fillRect(0, 0, width, height);
    this.middle = [width / 2, height / 2 + 20];
    if (this.follow && this.last) this.centre = this.last.at;
    pen.font = "600 14px system-ui, sans-serif";
    pen.lineJoin = "round";
    this.grid(pen, colour("card"), width, height);
    this.fences(pen, colour("fence"));
    this.path(pen, this.trail, colour("trail"), 3, []);
    this.sights(pen, colour);
    this.stationMarks(pen, colour);
    this.robot(pen, colour);
    this.scaleBar(pen, colour, width, height);
    this.compass(pen, colour, width, height);
  }

  grid(pen, colour, width, height) {
    const step = LENGTHS_M.find((length) => length * this.scale >= 70) || 5000;
    const reach = Math.hypot(width, height) / this.scale;
    pen.strokeStyle = colour;
    pen.lineWidth = 2;
    for (const axis of [0, 1]) {
      const first = Math.ceil((this.centre[axis] - reach) / step) * step;
      for (let at = first; at < this.centre[axis] + reach; at += step) {
        const ends = [-reach, reach].map((far) => axis === 0 ? [at, this.centre[1] + far] : [this.centre[0] + far, at]);
        this.line(pen, ends);
      }
    }
  }

  line(pen, points, close = false) {
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.at(point));
    if (close) pen.closePath();
    pen.stroke();
  }

  path(pen, points, colour, width, dash) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.beginPath();
    let drawing = false;
    for (const point of points) {
      if (!point) { drawing = false; continue; }
      const [x, y] = this.at(point);
      if (drawing) pen.lineTo(x, y); else pen.moveTo(x, y);
      drawing = true;
    }
    if (drawing && this.last && this.view && this.view.pose && this.view.pose.valid) pen.lineTo(...this.at(this.last.at));
    pen.stroke();
    pen.setLineDash([]);
  }

  fences(pen, colour) {
    if (!this.setup) return;
    pen.strokeStyle = pen.fillStyle = colour;
    pen.lineWidth = 3;
    pen.setLineDash([10, 6]);
    for (const fence of this.setup.fences) {
      this.line(pen, fence.polygon, true);
      const [x, y] = this.at(fence.polygon[0]);
      const text = `${fence.name}: stay ${fence.allowed_side}`, wide = this.canvas.clientWidth;
      const rightmost = wide - 60 - pen.measureText(text).width; // left of the compass
      pen.fillText(text, x < wide ? Math.min(x + 6, rightmost) : x + 6, y - 6);
    }
    pen.setLineDash([]);
  }

  // To the prism as the pose has it; dashed where the pose is not valid, to where the station measured it last.
  sights(pen, colour) {
    if (!this.setup || !this.view) return;
    const pose = this.view.pose;
    for (const tile of this.view.stations) {
      const station = this.setup.stations.find((each) => each.id === tile.id);
      if (!station) continue;
      const prism = pose && pose.valid && tile.state === "tracking" ? pose.prisms[tile.prism] : null;
      const end = prism || tile.sight;
      if (!end) continue;
      pen.strokeStyle = colour(`p${(tile.prism - 1) % 4 + 1}`);
      pen.lineWidth = 2;
      pen.setLineDash(prism ? [] : [6, 6]);
      this.line(pen, [station.at, end]);
      pen.setLineDash([]);
      pen.beginPath();
      pen.arc(...this.at(end), 3.5, 0, 2 * Math.PI);
      pen.fillStyle = pen.strokeStyle;
      pen.fill();
    }
  }

  stationMarks(pen, colour) {
    if (!this.setup) return;
    const fill = { tracking: "good", searching: "care", silent: "bad" };
    for (const station of this.setup.stations) {
      const tile = this.view && this.view.stations.find((each) => each.id === station.id);
      const [x, y] = this.at(station.at);
      pen.fillStyle = colour(!this.stale && tile && fill[tile.state] || "line");
      pen.strokeStyle = colour("front");
      pen.lineWidth = 2;
      pen.beginPath();
      pen.moveTo(x, y - 11); pen.lineTo(x + 10, y + 8); pen.lineTo(x - 10, y + 8); pen.closePath();
      pen.fill(); pen.stroke();
      this.label(pen, colour, String(station.id), x + 13, y + 8);
    }
  }

  robot(pen, colour) {
    if (!this.last) return;
    const live = !this.stale && this.view && this.view.pose && this.view.pose.valid;
    const [x, y] = this.at(this.last.at);
    const [c, s] = this.rotation();
    const world = this.last.heading_rad;
    const turned = Math.atan2(Math.sin(world) * c + Math.cos(world) * s, Math.cos(world) * c - Math.sin(world) * s);
    pen.save();
    pen.translate(x, y);
    pen.rotate(-turned);
    pen.beginPath();
    pen.moveTo(0, -20); pen.lineTo(12, 14); pen.lineTo(0, 7); pen.lineTo(-12, 14); pen.closePath();
    pen.lineWidth = 3;
    pen.strokeStyle = colour("front");
    if (live) { pen.fillStyle = colour("trail"); pen.fill(); } else { pen.setLineDash([4, 4]); }
    pen.stroke();
    pen.restore();
    if (!live) this.label(pen, colour, "last known position", x + 18, y + 5);
  }

  label(pen, colour, text, x, y) {
    pen.lineWidth = 4;
    pen.strokeStyle = colour("back");
    pen.strokeText(text, x, y);
    pen.fillStyle = colour("front");
    pen.fillText(text, x, y);
  }

  scaleBar(pen, colour, width, height) {
    const metres = [...LENGTHS_M].reverse().find((length) => length * this.scale <= Math.min(160, width / 3)) || LENGTHS_M[0];
    const pixels = metres * this.scale, x = 14, y = height - 14;
    pen.strokeStyle = colour("front");
    pen.lineWidth = 3;
    pen.beginPath();
    pen.moveTo(x, y - 8); pen.lineTo(x, y); pen.lineTo(x + pixels, y); pen.lineTo(x + pixels, y - 8);
    pen.stroke();
    this.label(pen, colour, `${metres} m`, x + 6, y - 8);
  }

  compass(pen, colour, width, height) {
    const [c, s] = this.rotation();
    pen.save();
    pen.translate(width - 30, height - 34);
    pen.rotate(-Math.atan2(s, c));
    pen.strokeStyle = pen.fillStyle = colour("front");
    pen.lineWidth = 3;
    pen.beginPath();
    pen.moveTo(0, 16); pen.lineTo(0, -12); pen.moveTo(-6, -5); pen.lineTo(0, -14); pen.lineTo(6, -5);
    pen.stroke();
    pen.restore();
    this.label(pen, colour, "0", width - 34 - 24 * Math.sin(Math.atan2(s, c)), height - 52);
  }
}
