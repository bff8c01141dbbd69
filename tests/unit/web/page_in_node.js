// Runs page.js without a browser: a document of which nothing is looked at, and clocks, connections and messages that the
// scenario (argument 2, the body of a function) sets. Argument 3: whether it is a replay, yes or no. The scenario's result is printed as JSON.

const { readFileSync } = require("node:fs");

const [file, scenario, replay] = process.argv.slice(2);
const page = readFileSync(file, "utf8").replace(/^import .*$/gm, "");

// Everything that an element has is another element, and every call returns one.
function element() {
  const selected = {};
  const own = {
    dataset: {}, children: [], textContent: "", clientWidth: 100, [Symbol.toPrimitive]: () => "",
    querySelector: (selector) => selected[selector] ??= element(),
    append: (...added) => { own.children.push(...added); },
    replaceChildren: () => { own.children.length = 0; },
  };
  return new Proxy(function () {}, {
    get: (_, name) => name in own ? own[name] : name === "querySelectorAll" ? () => [element(), element()] : element(),
    apply: () => element(),
    set: (_, name, value) => { own[name] = value; return true; },
  });
}

const elements = {};
const document = element();
document.getElementById = (id) => elements[id] ??= element();
document.body = element();
document.body.dataset = { replay, encrypted: "no" };
document.documentElement = element();

// Both clocks of the device; a device's sleep may stop the first.
const time = { steady_ms: 5000, wall_ms: 1e12 };
const performance = { now: () => time.steady_ms };
const Clock = class extends Date { static now() { return time.wall_ms; } };

const connections = [];
const EventSource = class {
  static CLOSED = 2;
  constructor(url) { this.url = url; this.readyState = 1; this.fresh = true; connections.push(this); }
  close() {}
};

const timers = [];
const MissionMap = class { constructor() { this.trail = []; this.last = null; } update() {} draw() {} };
const names = ["document", "window", "MissionMap", "drawChart", "EventSource", "performance", "Date", "setInterval", "fetch", "location", "localStorage"];
const storage = { getItem: () => null, setItem: () => {} };
const { verdict, map, events } = new Function(...names, `${page}\nreturn { verdict, map, events: () => events };`)(
  document, element(), MissionMap, () => [], EventSource, performance, Clock, (timer) => timers.push(timer), () => Promise.resolve({}), {}, storage);

const nothing = { first: 0, items: [] };
const view = {
  now_s: 0, source: "", stamp_ms: 0, verdict: { words: "GOOD", cause: "", urgent: false }, alarms: [], pose: null, figures: {},
  stations: [], imu: null, odometry: null, radio: null,
};

const robot = { ahead_s: 1000 }; // its clock, which stands still while it is suspended, beyond the page's steady one

const content = {}; // of the messages to come, beside the view

const scenes = {
  connections, robot, view, content, map, events,
  textOf: (id, selector) => elements[id].querySelector(selector).textContent,
  facts: () => elements.facts.children.map(({ textContent }) => textContent),
  words: () => verdict().words,
  // Let time pass, without the page's timers; the steady clock stands still in sleep.
  pass: (ms, steady_ms = ms) => { time.wall_ms += ms; time.steady_ms += steady_ms; },
  timers: () => { for (const timer of timers) timer(); },
  sent_s: () => time.steady_ms / 1000 + robot.ahead_s,
  text: (sent_s, first = false) => JSON.stringify({ first, sent_s, view, trail: nothing, residuals: nothing, events: nothing, ...content }),
  // Hand a message to the newest connection.
  message: (sent_s = scenes.sent_s()) => {
    const source = connections.at(-1);
    source.onmessage({ data: scenes.text(sent_s, source.fresh) });
    source.fresh = false;
  },
  // Let time pass with messages that come at once, and the page's timers.
  run: (ms) => {
    const shown = [];
    for (let at_ms = 0; at_ms < ms; at_ms += 200) {
      scenes.pass(200);
      scenes.message();
      scenes.timers();
      shown.push(verdict().words);
    }
    return shown;
  },
};
process.stdout.write(JSON.stringify(new Function(...Object.keys(scenes), scenario)(...Object.values(scenes))));
