// The operator's page. The server says what to show; this file shows it, and judges by its own clock whether it is still true.
// Text from outside goes into text nodes only.

import { MissionMap } from "/map.js";
import { drawChart } from "/chart.js";

const SILENCE_LIMIT_MS = 1500; // messages come every 200 ms
const LATE_LIMIT_MS = 1500;
const RECONNECT_MS = 4000; // a connection that gives nothing in time for this long is replaced
const REFUSED_MS = 1000; // then one that was refused is tried again
const CHECK_MS = 200;
const CLOCK_SKEW = 1e-4;
const MAX_TRAIL = 1500, MAX_RESIDUALS = 600, MAX_EVENTS = 100;

const LEVELS = {
  "GOOD": { class: "good", sign: "✓", rank: 0 },
  "CARE": { class: "care", sign: "▲", rank: 1 },
  "NO POSE": { class: "pose", sign: "✕", rank: 2 },
  "STREAM STOPPED": { class: "stopped", sign: "■", rank: 3 },
  "NO CONNECTION": { class: "none", sign: "?", rank: 4 },
};

const find = (id) => document.getElementById(id);
const replaying = document.body.dataset.replay === "yes";
const map = new MissionMap(find("map"));

let source = null;
let opened_ms = 0; // at the earliest: the newest connection was made after it
let received_ms = -Infinity, timely_ms = -Infinity; // the last message, and the last one that was not late
let clocks_ms = 0, received_clocks_ms = 0; // what clocks() was at the last message or connection, and at the last message
let least_offset_ms = Infinity, late_ms = 0;
let view = null, residuals = [], events = [];
const ends = {}; // of each series: the number that its next item has
let shown = "", sounded = 0, audio = null;
let playing = { at_s: 0, speed: 1, length_s: 0, start_ms: 0 }, seeking = false;

// --- connection ------------------------------------------------------------------------------------------------

// It jumps when the device sleeps, as performance.now() then stands still on many; and when the wall clock is set.
const clocks = () => Date.now() - performance.now();

function opening() {
  opened_ms = performance.now();
  clocks_ms = clocks();
}

function connect(query = "") {
  if (source) source.close();
  opening();
  const own = source = new EventSource(`/stream${query}`);
  own.onmessage = (event) => { if (own === source) take(JSON.parse(event.data)); };
  own.onerror = () => {
    if (own !== source) return;
    // By the browser itself, which asks for the same address again: in a replay that is where this connection began.
    if (own.readyState !== EventSource.CLOSED && !replaying) { opening(); return; }
    own.close();
    source = null; // replaying, or refused: the code has changed, or too many readers
    fetch("/", { method: "HEAD" }).then((response) => { if (response.status === 401) location.assign("/"); }, () => {});
  };
}

// What was received until now says nothing of the present.
function reconnect() {
  late_ms = 0;
  received_ms = Math.min(received_ms, performance.now() - SILENCE_LIMIT_MS - 1);
  connect(query());
}

const query = () => replaying ? `?at=${playing.at_s.toFixed(1)}&speed=${playing.speed}` : "";

function take(message) {
  const now_ms = performance.now();
  // The device has slept: this message may have waited in a buffer meanwhile, and so may those after it.
  if (Math.abs(clocks() - clocks_ms) > SILENCE_LIMIT_MS) {
    if (now_ms - opened_ms > RECONNECT_MS) reconnect();
    return;
  }
  const offset_ms = now_ms - 1000 * message.sent_s;
  const elapsed_ms = Number.isFinite(received_ms) ? now_ms - received_ms : 0;
  least_offset_ms = Math.min(least_offset_ms + CLOCK_SKEW * elapsed_ms, offset_ms);
  // The robot's clock stood still while its computer was suspended, or began again: the first message is no older than its connection.
  if (message.first) least_offset_ms = Math.max(least_offset_ms, opened_ms - 1000 * message.sent_s);
  late_ms = offset_ms - least_offset_ms;
  received_ms = now_ms;
  if (late_ms <= LATE_LIMIT_MS) timely_ms = now_ms;
  clocks_ms = received_clocks_ms = clocks();
  view = message.view;
  if (message.setup !== undefined) {
    // In another frame the last valid pose was elsewhere.
    if (map.setup && message.setup && JSON.stringify(map.setup.stations) !== JSON.stringify(message.setup.stations)) map.last = null;
    map.setup = message.setup;
    map.fitted = map.fitted && !message.first;
  }
  map.trail = appended(map.trail, message, "trail", MAX_TRAIL);
  residuals = appended(residuals, message, "residuals", MAX_RESIDUALS);
  if (message.first || message.events.items.length) {
    events = appended(events, message, "events", MAX_EVENTS);
    showEvents();
  }
  if (message.replay) showReplay(message.replay);
  show();
}

// What is here already may come again, just after connecting; after a gap the server has dropped everything before it.
function appended(list, message, name, limit) {
  const { first, items } = message[name];
  const kept = message.first || first > ends[name] ? [] : list;
  const fresh = message.first ? items : items.slice(Math.max(ends[name] - first, 0));
  ends[name] = first + items.length;
  return [...kept, ...fresh].slice(-limit);
}

// What the page may claim now: the server's verdict only while its messages come, and come in time.
function verdict() {
  const now_ms = performance.now();
  const silence_ms = now_ms - received_ms;
  if (!view) return { words: "NO CONNECTION", cause: "waiting for the first message" };
  const slept = Math.abs(clocks() - received_clocks_ms) > SILENCE_LIMIT_MS;
  if (silence_ms > SILENCE_LIMIT_MS || slept) {
    return { words: "NO CONNECTION", cause: `nothing received for ${Math.max(silence_ms / 1000, 1).toFixed(0)} s: what is shown is old` };
  }
  if (late_ms > LATE_LIMIT_MS) return { words: "NO CONNECTION", cause: `messages arrive ${(late_ms / 1000).toFixed(0)} s late` };
  return view.verdict;
}

function check() {
  const now_ms = performance.now();
  if (now_ms - Math.max(timely_ms, opened_ms) > (source ? RECONNECT_MS : REFUSED_MS)) reconnect();
  if (!view || verdict() !== view.verdict) show(); // else the last message has been shown
}

// --- showing ---------------------------------------------------------------------------------------------------

function show() {
  const now = verdict(), level = LEVELS[now.words];
  const stale = level.rank >= 3;
  const header = find("verdict");
  header.className = level.class + (now.urgent ? " urgent" : "");
  text(find("sign"), level.sign);
  text(find("words"), now.words);
  text(find("cause"), now.cause);
  document.body.classList.toggle("stale", stale);
  text(find("time"), view ? `${clock(view.stamp_ms)} UTC` : "–");
  text(find("source"), (replaying ? "REPLAY " : "") + (view ? view.source : ""));
  document.title = `${now.words} – tsgt`;
  speak(now, level);
  const live = level.rank === 4 ? null : view;
  showAlarms(live ? live.alarms : []);
  showFigures(live && !stale ? live.figures : {});
  showStations(live ? live.stations : (view ? view.stations.map(({ id }) => ({ id, state: "unknown", words: "unknown" })) : []));
  showFacts(live && !stale ? live : null);
  if (live) map.update(live, stale); else map.update(view && { ...view, pose: null, stations: [] }, true);
  find("map").setAttribute("aria-label", mapText(live));
  const prisms = drawChart(find("chart"), residuals, view ? view.now_s : 0, view && view.figures.residual_limit_mm);
  showLegend(prisms, stale);
}

function text(element, content) {
  if (element.textContent !== content) element.textContent = content;
}

function child(parent, name, content = "", className = "") {
  const element = document.createElement(name);
  element.textContent = content;
  if (className) element.className = className;
  parent.append(element);
  return element;
}

// A screen reader hears the verdict when it changes, not each time a number in it does.
function speak(now, level) {
  const said = `${now.words}: ${now.cause}`;
  const essence = said.replace(/[0-9.]+ (s|min|h|m|mm|MB|deg|lines)\b/g, "");
  if (essence === shown) return;
  shown = essence;
  text(find("spoken"), said);
  if (audio && level.rank > 0) beep(level.rank);
}

function showAlarms(alarms) {
  const list = find("alarms"), key = JSON.stringify(alarms);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren();
  for (const alarm of alarms) child(list, "li", alarm.text, alarm.urgent ? "urgent" : "");
}

function figure(id, big, small, state) {
  const card = find(id);
  card.className = `figure ${state}`;
  text(card.querySelector("b"), big);
  text(card.querySelector(".small"), small);
}

function graded(value, limit) {
  if (value === null || value === undefined || !limit) return "";
  return value > limit ? "bad" : value > limit / 2 ? "warn" : "ok";
}

// Position and rotation, the worse of them.
function gradedSigmas(sigmas, limit_mm, limit_deg) {
  const grades = [graded(sigmas.position_mm, limit_mm), graded(sigmas.rotation_deg, limit_deg)];
  return ["bad", "warn", "ok"].find((grade) => grades.includes(grade)) || "";
}

function length(mm) {
  if (mm === null || mm === undefined) return "–";
  return mm < 10 ? `${mm.toFixed(1)} mm` : mm < 1000 ? `${mm.toFixed(0)} mm` : `${(mm / 1000).toFixed(1)} m`;
}

function showFigures(f) {
  const rotation = (sigmas) => sigmas && sigmas.rotation_deg !== null ? `${sigmas.rotation_deg.toFixed(2)}°` : "";
  const limit = (mm, deg) => mm ? `, limit ${mm.toFixed(0)} mm${deg ? `, ${Number(deg.toFixed(1))}°` : ""}` : "";
  const live = f.live || {}, later = f.smoothed || {};
  figure("f-sigma", length(live.position_mm), rotation(f.live) + (f.live ? limit(f.sigma_limit_mm, f.rotation_limit_deg) : ""), gradedSigmas(live, f.sigma_limit_mm, f.rotation_limit_deg));
  figure("f-later", length(later.position_mm), f.smoothed ? rotation(f.smoothed) + (f.delay_s ? `, ${f.delay_s} s later` : ", final") : "", gradedSigmas(later, f.smoothed_limit_mm, f.smoothed_rotation_limit_deg));
  figure("f-fit", length(f.residual_mm), f.residual_limit_mm ? `limit ${f.residual_limit_mm.toFixed(0)} mm` : "", graded(f.residual_mm, f.residual_limit_mm));
  const share = f.valid_share;
  figure("f-valid", share === null || share === undefined ? "–" : `${(100 * share).toFixed(share === 1 ? 0 : 1)} %`,
    f.poses ? `last minute; ${f.valid_poses} of ${f.poses} since the start` : "", share === null || share === undefined ? "" : share < 0.9 ? "bad" : share < 0.99 ? "warn" : "ok");
  const age = f.data_age_s;
  figure("f-age", age === null || age === undefined ? "–" : `${age.toFixed(1)} s`,
    f.oldest_age_s !== null && f.oldest_age_s !== undefined ? `oldest prism ${f.oldest_age_s.toFixed(1)} s` : "",
    f.outage_limit_s && f.oldest_age_s !== null ? (age > f.outage_limit_s ? "bad" : f.oldest_age_s > f.outage_limit_s ? "warn" : "ok") : "");
}

const given = (value, unit, digits) => value === null || value === undefined ? null : `${digits === undefined ? value : value.toFixed(digits)} ${unit}`.trim();

function showStations(stations) {
  const section = find("stations");
  while (section.children.length > stations.length) section.lastChild.remove();
  stations.forEach((station, index) => {
    let tile = section.children[index];
    if (!tile) {
      tile = child(section, "article");
      const head = child(tile, "h3");
      child(head, "span"); child(head, "span");
      child(tile, "p", "", "state");
      child(tile, "p", "", "note");
      child(tile, "dl");
    }
    tile.className = `station ${station.state}`;
    const [name, prism] = tile.querySelectorAll("h3 span");
    text(name, `Station ${station.id}`);
    text(prism, station.prism ? `prism ${station.prism}` : "");
    text(tile.querySelector(".state"), station.words.charAt(0).toUpperCase() + station.words.slice(1));
    text(tile.querySelector(".note"), station.note || "");
    const facts = [
      ["rate", given(station.rate_hz, "Hz", 1)],
      ["range", given(station.range_m, "m", 2)],
      ["clock", station.bound_ms === null || station.bound_ms === undefined ? null : `±${station.bound_ms.toFixed(2)} ms`],
      ["backlog", station.backlog > 20 && station.drain_s !== null && station.drain_s !== undefined
        ? `${station.backlog}, ends in ${minutesAndHours(station.drain_s)}`
        : given(station.backlog, "")],
      ["signal", given(station.rssi_dbm, "dBm", 0)],
      ["SNR", given(station.snr_db, "dB", 0)],
      ["loss", station.loss === null || station.loss === undefined ? null : `${(100 * station.loss).toFixed(0)} %`],
      ["battery", given(station.battery_percent, "%")],
      ["heard", given(station.heard_s, "s ago", 1)],
      ["atm.", given(station.air_ppm, "ppm", 1)],
      ["checked", station.check_s === null || station.check_s === undefined ? null : `${minutesAndHours(station.check_s)} ago`],
    ].filter(([, value]) => value !== null);
    rows(tile.querySelector("dl"), facts);
  });
}

function minutesAndHours(s) {
  return s < 5400 ? `${Math.round(s / 60)} min` : `${Math.round(s / 3600)} h`;
}

function rows(list, facts) {
  const key = facts.map(([name]) => name).join();
  if (list.dataset.key !== key) {
    list.dataset.key = key;
    list.replaceChildren();
    for (const [name] of facts) { child(list, "dt", name); child(list, "dd"); }
  }
  facts.forEach(([, value, bad], index) => {
    const cell = list.children[2 * index + 1];
    text(cell, value);
    cell.classList.toggle("bad", Boolean(bad));
  });
}

function bytes(count) {
  if (count < 1e6) return `${(count / 1e3).toFixed(0)} kB`;
  return count < 1e9 ? `${(count / 1e6).toFixed(0)} MB` : `${(count / 1e9).toFixed(1)} GB`;
}

function showFacts(live) {
  const facts = [];
  if (live && live.recording && live.recording.file) {
    const { file, bytes: size, write_age_s } = live.recording;
    facts.push(["recording", [file, size ? bytes(size) : "", write_age_s > 2 ? `written ${write_age_s.toFixed(0)} s ago` : ""].filter(Boolean).join(", "), live.recording.bad]);
  }
  if (live && live.disk) facts.push(["disk", `${bytes(live.disk.free_bytes)} free of ${bytes(live.disk.total_bytes)}`, live.disk.bad]);
  if (live && live.radio && live.radio.protocol) {
    facts.push(["radio", live.radio.protocol + (live.radio.authenticated ? ", with a key" : ", NO KEY: anybody can take part"), !live.radio.authenticated]);
  }
  if (live && live.imu) facts.push(["IMU", [live.imu.device, live.imu.use ? live.imu.use.replace("_", " ") : "", live.imu.rate_hz ? `${live.imu.rate_hz.toFixed(0)} Hz` : ""].filter(Boolean).join(", "), false]);
  if (live && live.odometry) {
    const { device, use, rate_hz, slip, rejected } = live.odometry;
    const shown = [device, use ? use.replace("_", " ") : "", rate_hz ? `${rate_hz.toFixed(0)} Hz` : "", slip !== null ? `slip ${(100 * slip).toFixed(1)} %` : "", rejected ? `${(100 * rejected).toFixed(0)} % rejected` : ""];
    facts.push(["wheels", shown.filter(Boolean).join(", "), use === "disagrees"]);
  }
  if (live && live.pose && live.pose.valid && live.pose.speed_mps !== null) facts.push(["robot", `x ${live.pose.at[0].toFixed(2)}, y ${live.pose.at[1].toFixed(2)}, z ${live.pose.at[2].toFixed(2)} m; ${live.pose.speed_mps.toFixed(1)} m/s`, false]);
  rows(find("facts"), facts);
  find("storage").hidden = !facts.length;
}

function showEvents() {
  const list = find("events");
  list.replaceChildren();
  for (const event of [...events].reverse()) {
    const line = child(list, "li", "", { alarm: "alarm", good: "good-news" }[event.kind] || "");
    const time = child(line, "time", clock(event.stamp_ms));
    time.dateTime = new Date(event.stamp_ms).toISOString();
    line.append(event.text);
  }
  if (!events.length) child(list, "li", "none yet");
}

function showLegend(prisms, stale) {
  const legend = find("legend"), key = prisms.join();
  if (legend.dataset.key !== key) {
    legend.dataset.key = key;
    legend.replaceChildren();
    for (const prism of prisms) child(legend, "span", "", `c${Number(prism) % 4}`);
  }
  const last = residuals.length && !stale ? residuals[residuals.length - 1][1] : {};
  prisms.forEach((prism, index) => text(legend.children[index], `prism ${prism}: ${last[prism] === undefined ? "–" : length(last[prism])}`));
  find("chart").setAttribute("aria-label", `Residuals: ${legend.textContent}`);
}

function mapText(live) {
  if (!live || !live.pose || !live.pose.valid) return "Map: no valid pose now";
  const [x, y] = live.pose.at, degrees = Math.round(live.pose.heading_rad * 180 / Math.PI);
  return `Map: robot at x ${x.toFixed(1)} m, y ${y.toFixed(1)} m, heading ${degrees} degrees`;
}

function clock(stamp_ms) {
  return stamp_ms ? new Date(stamp_ms).toISOString().slice(11, 19) : "–";
}

// --- replay ----------------------------------------------------------------------------------------------------

function showReplay(bar) {
  playing.at_s = bar.at_s;
  if (bar.length_s !== undefined) {
    Object.assign(playing, { length_s: bar.length_s, start_ms: bar.start_ms });
    find("at").max = bar.length_s;
    const marks = find("marks");
    if (marks.dataset.key !== String(bar.marks.length)) {
      marks.dataset.key = String(bar.marks.length);
      marks.replaceChildren();
      for (const [at_s, kind] of bar.marks) child(marks, "i", "", kind).style.left = `${100 * at_s / Math.max(bar.length_s, 1)}%`;
    }
  }
  if (!seeking) find("at").value = bar.at_s;
  const minutes = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
  text(find("at-text"), `${minutes(bar.at_s)} of ${minutes(playing.length_s)}`);
  text(find("play"), playing.speed ? "Pause" : "Play");
}

function seek(at_s, speed = playing.speed) {
  playing.at_s = Math.min(Math.max(at_s, 0), playing.length_s);
  playing.speed = speed;
  connect(query());
}

function toggle() {
  const speed = Number(find("speed").value);
  seek(playing.at_s >= playing.length_s ? 0 : playing.at_s, playing.speed ? 0 : speed);
}

if (replaying) {
  find("replay").hidden = false;
  let timer = 0;
  find("at").addEventListener("input", () => {
    seeking = true;
    clearTimeout(timer);
    timer = setTimeout(() => { seeking = false; seek(Number(find("at").value)); }, 200);
  });
  find("play").addEventListener("click", toggle);
  find("speed").addEventListener("change", () => { if (playing.speed) seek(playing.at_s, Number(find("speed").value)); });
}

// --- buttons and keys ------------------------------------------------------------------------------------------

function press(id, on) { find(id).setAttribute("aria-pressed", String(on)); }

map.onMove = () => press("follow", map.follow);
const actions = {
  follow: () => { map.follow = !map.follow; press("follow", map.follow); map.draw(); },
  north: () => { map.north = !map.north; press("north", map.north); text(find("north"), map.north ? "North up" : "Heading up"); map.draw(); },
  fit: () => { map.follow = false; press("follow", false); map.fit(); },
  in: () => map.zoom(1.4),
  out: () => map.zoom(1 / 1.4),
  sound: () => {
    audio = audio ? null : new AudioContext();
    press("sound", audio !== null);
    text(find("sound"), audio ? "Sound on" : "Sound off");
    if (audio) beep(0);
  },
  theme: () => setTheme({ device: "light", light: "dark", dark: "device" }[theme]),
};
for (const [id, action] of Object.entries(actions)) find(id).addEventListener("click", action);

const keys = { f: "follow", n: "north", 0: "fit", "+": "in", "-": "out", s: "sound", t: "theme" };
const arrows = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] };
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select")) return;
  if (keys[event.key]) actions[keys[event.key]]();
  else if (arrows[event.key] && document.activeElement === find("map")) { map.pan(...arrows[event.key]); event.preventDefault(); }
  else if (replaying && event.key === " " && !event.target.matches("button")) { toggle(); event.preventDefault(); }
  else if (replaying && (event.key === "," || event.key === ".")) seek(playing.at_s + (event.key === "," ? -10 : 10));
});

function beep(rank) {
  const from_s = audio.currentTime;
  for (let i = 0; i < Math.max(1, Math.min(rank, 3)); i += 1) {
    const tone = audio.createOscillator(), volume = audio.createGain();
    tone.frequency.value = rank ? 660 + 220 * (rank > 1) : 440;
    volume.gain.value = rank ? 0.3 : 0.05;
    tone.connect(volume).connect(audio.destination);
    tone.start(from_s + 0.25 * i);
    tone.stop(from_s + 0.25 * i + 0.15);
  }
  sounded = performance.now();
}

// What must not be overheard sounds again and again.
function remind() {
  const now = verdict(), rank = LEVELS[now.words].rank;
  if (audio && (rank > 1 || now.urgent) && performance.now() - sounded > 5000) beep(rank);
}

let theme = "device";
function setTheme(name) {
  theme = name;
  if (name === "device") delete document.documentElement.dataset.theme; else document.documentElement.dataset.theme = name;
  text(find("theme"), `Colours: ${name}`);
  try { localStorage.setItem("theme", name); } catch { /* private window */ }
  show();
}

const encrypted = document.body.dataset.encrypted === "yes";
text(find("connection"), encrypted
  ? "This connection is encrypted. If the browser accepted the certificate without a warning, it is your robot's."
  : "This connection is not encrypted. On the robot itself, or through ssh, nobody else sees it. On a Wi-Fi hotspot its password keeps strangers off the network, but everyone who knows it can read along and take the access code. The page can change nothing on the robot.");

let stored = null;
try { stored = localStorage.getItem("theme"); } catch { /* private window */ }
setTheme(["light", "dark"].includes(stored) ? stored : "device");
showEvents();
setInterval(() => { check(); remind(); }, CHECK_MS);
document.addEventListener("visibilitychange", show);
window.addEventListener("resize", show);
connect();
