// The page's only script. State comes over one WebSocket: the whole table once, then changes. Orders leave as POSTs.
const at = (id) => document.getElementById(id);
const table = new Map();   // "component:/lab/r1/mapper" → its fields
const past = new Map();    // key of a chart → [[seconds of this page's clock, [values]], …]
const story = new Map();   // component → its decisions; the same for its output
const output = new Map();
const mine = new Set();    // IDs of orders that this window gave
let session = null, view = null, socket = null, wait = 500, framed = false, lost = "";

// --- Elements and words ----------------------------------------------------------------------------------------------
const DRAWN = new Set(["svg", "polyline", "path", "line", "circle", "text"]);
const el = (tag, props = {}, ...children) => {
  const made = DRAWN.has(tag) ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== false && value != null) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child != null));
  return made;
};
const set = (node, text) => { if (node.textContent !== text) node.textContent = text; };
const mark = (node, name, value) => { if (node.getAttribute(name) !== value) node.setAttribute(name, value); };
const rows = (kind) => [...table].filter(([key]) => key.startsWith(kind + ":")).map(([key, fields]) => [key.slice(kind.length + 1), fields]);
const order = new Intl.Collator("en", { numeric: true });
const compare = (a, b) => order.compare(a[0], b[0]);
const ms = (value) => value == null ? "–" : value < 1000 ? `${+value.toFixed(value < 10 ? 2 : 0)} ms` : value < 120000 ? `${(value / 1000).toFixed(1)} s` : `${Math.round(value / 60000)} min`;
const tenths = (value) => value == null ? "–" : `${value.toFixed(1)} ms`;
const size = (value) => { for (const unit of ["B", "KB", "MB"]) { if (value < 1000) return `${+value.toFixed(1)} ${unit}`; value /= 1000; } return `${value.toFixed(1)} GB`; };
const clock = (date) => date.toDateString() === new Date().toDateString() ? date.toLocaleTimeString("en-GB") : date.toLocaleString("en-GB");
const short = (name) => name.split("/").pop();
const list = (values) => values.length ? values.join(", ") : "–";
const link = (kind, name) => `#/${kind}/${encodeURIComponent(name)}`;

const SIGNS = { protected: ["●", "good"], degraded: ["▲", "warn"], alone: ["◆", "warn"], failed: ["✕", "bad"], unknown: ["?", "bad"], dead: ["✕", "bad"],
  live: ["●", "good"], suspect: ["▲", "warn"], ended: ["–", "quiet"], unreachable: ["?", "warn"], waiting: ["○", "quiet"], running: ["●", "good"], "at once": ["●", "good"], silent: ["✕", "bad"], listening: ["○", "quiet"], idle: ["–", "warn"], simulated: ["◌", "quiet"] };
const sign = (word) => SIGNS[word] || ["○", "quiet"];

// --- The table, and what is drawn of it ---------------------------------------------------------------------------------
const take = (message) => {
  for (const [key, fields] of Object.entries(message.set || {})) table.set(key, { ...table.get(key), ...fields });
  for (const [key, names] of Object.entries(message.without || {})) for (const name of names) delete table.get(key)[name];
  for (const key of message.gone || []) table.delete(key);
  for (const key of Object.keys(message.set || {})) if (key.startsWith("order:") && mine.has(table.get(key).id)) tellOrder(table.get(key));
  if (message.past) past.set(message.past.key, message.past.points.map(([age, values]) => [performance.now() / 1000 - age, values]));
  if (message.story) story.set(message.story.name, message.story);
  if (message.output) takeOutput(message.output);
  if (!framed) { framed = true; requestAnimationFrame(draw); }
};
const takeOutput = ({ name, text, left_out, says }) => {
  const held = output.get(name) || { 1: "", 2: "", says: "" };
  for (const [stream, more] of Object.entries(text)) held[stream] = (held[stream] + more).slice(-32768);
  output.set(name, { ...held, says: says || (left_out ? `${size(left_out)} were left out: this page was too slow for them` : "") });
};
const addPoint = (key, fields) => {
  const points = past.get(key) || [], now = performance.now() / 1000;
  points.push([now, key.startsWith("item:") ? [fields.value] : key.startsWith("medium:") ? [fields.round_ms, fields.count] : [fields.lag_ms, fields.freeze_us == null ? null : fields.freeze_us / 1000]]);
  past.set(key, points.slice(-600));
};
const draw = () => {
  framed = false;
  const team = table.get("team") || {};
  set(at("title"), team.team ? `${team.team}: ${team.healthy ? "all is well" : "look here"}` : "failover");
  document.title = team.team ? `${team.healthy && !team.away ? "" : "! "}${team.team} – failover` : "failover";
  set(at("promise"), team.promise || "");
  away(lost || team.away || (team.old_s ? `The agent has told nothing new for ${team.old_s} s.` : ""));
  const people = rows("person").map(([, one]) => one);
  set(at("people"), people.length < 2 ? people.map((one) => one.user).join() : people.map((one) => `${one.user}${one.me ? " (you)" : one.looks ? ` looks at ${short(one.looks)}` : ""}`).join(", "));
  drawTree();
  view?.update?.();
};
setInterval(() => {   // a point a second, also of a value that stands still
  const one = table.get(view?.key);
  if (one && !lost && !table.get("team")?.away && /^(component|item|medium):/.test(view.key)) { addPoint(view.key, one); draw(); }
}, 1000);
const away = (why) => { at("away").hidden = !why; set(at("away"), why && `What you see is old. ${why}`); };

// --- The tree -----------------------------------------------------------------------------------------------------------
const nodes = new Map();   // key → its treeitem
const treeOf = () => {
  const team = table.get("team") || {}, found = [{ key: "team", name: team.team || "team", word: team.healthy ? "well" : "look here", sign: team.healthy ? SIGNS.live : SIGNS.degraded, level: 1 }];
  const components = rows("component").sort(compare), tasks = rows("task").sort(compare), named = rows("driver").sort(compare);
  const drivers = named.filter(([, own]) => own.kind !== "simulated");
  const robots = rows("robot").sort((a, b) => b[1].here - a[1].here || compare(a, b));
  const branch = (list, level) => {
    for (const [name, one] of list) {
      found.push({ key: `component:${name}`, name: short(name), word: one.word, sign: sign(one.word), why: one.why, level });
      for (const [task, own] of tasks.filter(([, own]) => own.component === name)) found.push(taskNode(task, own, level + 1));
    }
  };
  for (const [name, robot] of robots) {
    found.push({ key: `robot:${name}`, name, word: [robot.here ? "here" : "", robot.role === "robot" ? "" : robot.role, robot.state].filter(Boolean).join(", "), sign: sign(robot.state), level: 2 });
    branch(components.filter(([, one]) => one.primary === name), 3);
    for (const [task, own] of tasks.filter(([, own]) => own.robot === name && !table.has(`component:${own.component}`))) found.push(taskNode(task, own, 3));
    for (const [path, own] of drivers.filter(([, own]) => own.robot === name)) found.push({ key: `driver:${path}`, name: path, word: `driver, ${own.refused ? "refused" : own.reach}`, sign: sign(own.reach), level: 3 });
  }
  const orphans = components.filter(([, one]) => !table.has(`robot:${one.primary}`));
  if (orphans.length) { found.push({ key: "robot:", name: "at no robot", word: "", sign: SIGNS.unknown, level: 2 }); branch(orphans, 3); }
  return found.concat(simulatedNodes(named.filter(([, own]) => own.kind === "simulated")));
};
const simulatedNodes = (list) => {   // below the team, a node for each step of their paths, closed until a person opens it
  const found = [];
  let before = [];
  for (const [path, own] of list) {
    const steps = path.split("/");
    let depth = 0;
    while (depth < steps.length - 1 && steps[depth] === before[depth]) depth++;
    for (; depth < steps.length - 1; depth++) found.push({ key: `place:${steps.slice(0, depth + 1).join("/")}`, name: steps[depth], word: depth ? "" : "robots that are not there", sign: sign("simulated"), level: depth + 2, closed: true });
    found.push({ key: `driver:${path}`, name: steps.at(-1), word: `simulated, ${own.refused ? "refused" : own.reach}`, sign: sign(own.reach), level: steps.length + 1 });
    before = steps;
  }
  return found;
};
const taskNode = (name, own, level) => ({ key: `task:${name}`, name, word: `task, ${own.state}`, sign: sign(own.state), level });
const drawTree = () => {
  const wanted = treeOf(), parents = [at("tree")], counts = [0], seen = new Set(), had = document.activeElement?.closest("[role=treeitem]");
  for (const [index, one] of wanted.entries()) {
    seen.add(one.key);
    let node = nodes.get(one.key);
    if (!node) {
      const row = el("span", { class: "row" }, el("span", { class: "toggle", "aria-hidden": "true" }), el("span", { class: "sign", "aria-hidden": "true" }), el("span", { class: "name" }), el("span", { class: "word" }));
      node = el("li", { role: "treeitem", tabindex: nodes.size ? "-1" : "0", "data-key": one.key }, row);
      nodes.set(one.key, node);
    }
    const [, icon, name, word] = node.firstChild.children;
    set(icon, one.sign[0]); mark(icon, "class", `sign ${one.sign[1]}`);
    set(name, one.name); set(word, one.word || "");
    mark(node.firstChild, "title", one.why || "");
    mark(node, "aria-label", [one.name, one.word, one.why].filter(Boolean).join(", "));
    mark(node, "aria-level", String(one.level));
    mark(node, "aria-selected", String(view?.key === one.key));
    const parent = parents[one.level - 1], place = counts[one.level - 1]++;
    if (parent.children[place] !== node) parent.insertBefore(node, parent.children[place] || null);
    parents.length = counts.length = one.level;
    let group = node.querySelector(":scope > [role=group]");
    if (wanted[index + 1]?.level > one.level) {
      if (!group) { group = el("ul", { role: "group" }); node.append(group); mark(node, "aria-expanded", String(!one.closed)); }
    } else if (group) { group.remove(); node.removeAttribute("aria-expanded"); }
    parents.push(group); counts.push(0);
  }
  for (const [key, node] of nodes) if (!seen.has(key)) { node.remove(); nodes.delete(key); }
  const reached = at("tree").querySelector("[tabindex='0']"), shown = reached ? visible(reached) : at("tree").firstChild;
  if (had && (shown !== had || document.activeElement !== had)) focusNode(shown);   // it was moved to another robot, or is gone
  else if (shown && shown !== reached) { reached?.setAttribute("tabindex", "-1"); shown.tabIndex = 0; }
};
const visible = (node) => { for (let up = node; up = up.parentElement.closest("[role=treeitem]");) if (up.getAttribute("aria-expanded") === "false") node = up; return node; };
const focusNode = (node) => {
  if (!node) return;
  for (const other of at("tree").querySelectorAll("[tabindex='0']")) other.tabIndex = -1;
  node.tabIndex = 0; node.focus();
};
const go = (node) => { const [kind, ...rest] = node.dataset.key.split(":"); if (kind === "place") return mark(node, "aria-expanded", String(node.getAttribute("aria-expanded") === "false")); location.hash = kind === "team" || !rest[0] ? "#/" : link(kind, rest.join(":")); };
at("tree").addEventListener("click", (event) => { 
  const node = event.target.closest("[role=treeitem]"), open = node?.getAttribute("aria-expanded");
  if (!node) return;
  focusNode(node);
  if (open && event.target.classList.contains("toggle")) mark(node, "aria-expanded", String(open === "false")); else go(node);
});
at("tree").addEventListener("keydown", (event) => {
  const node = event.target.closest("[role=treeitem]"), open = node.getAttribute("aria-expanded");
  const shown = [...at("tree").querySelectorAll("[role=treeitem]")].filter((one) => !one.parentElement.closest("[aria-expanded=false]"));
  const place = shown.indexOf(node), up = node.parentElement.closest("[role=treeitem]");
  const acts = { ArrowDown: () => focusNode(shown[place + 1]), ArrowUp: () => focusNode(shown[place - 1]), Home: () => focusNode(shown[0]), End: () => focusNode(shown.at(-1)),
    ArrowRight: () => open === "false" ? node.setAttribute("aria-expanded", "true") : open && focusNode(shown[place + 1]),
    ArrowLeft: () => open === "true" ? node.setAttribute("aria-expanded", "false") : focusNode(up), Enter: () => go(node), " ": () => go(node) };
  if (acts[event.key] && !event.ctrlKey && !event.altKey && !event.metaKey) { event.preventDefault(); acts[event.key](); }
});

// --- Views: each is built once, and brought up to date ---------------------------------------------------------------------
const facts = () => {
  const node = el("dl"), cells = new Map();
  return [node, (pairs) => {
    for (const [label, value] of pairs) {
      if (!cells.has(label)) { const cell = el("dd"); cells.set(label, cell); node.append(el("dt", {}, label), cell); }
      set(cells.get(label), value == null || value === "" ? "–" : String(value));
    }
  }];
};
const heading = () => {
  const icon = el("span", { class: "sign", "aria-hidden": "true" }), word = el("strong"), why = el("span");
  return [el("p", {}, icon, " ", word, " ", why), (text, reason) => { set(icon, sign(text)[0]); mark(icon, "class", `sign ${sign(text)[1]}`); set(word, text); set(why, reason || ""); }];
};
const chart = (key, which, label, unit) => {
  const curve = el("polyline"), drawing = el("svg", { class: "chart", viewBox: "0 0 600 100", preserveAspectRatio: "none", role: "img" }, curve), caption = el("figcaption");
  return [el("figure", {}, drawing, caption), () => {
    const now = performance.now() / 1000, points = (past.get(key) || []).map(([t, values]) => [t, values[which]]).filter(([t, value]) => value != null && now - t < 600);
    const values = points.map(([, value]) => value), most = Math.max(...values, 0), least = Math.min(...values, 0), span = most - least || 1;
    mark(curve, "points", points.map(([t, value]) => `${(600 - (now - t)).toFixed(1)},${(98 - 96 * (value - least) / span).toFixed(1)}`).join(" "));
    const told = values.length ? `${label}: now ${unit(values.at(-1))}, at most ${unit(most)} in the last 10 min` : `${label}: not known`;
    set(caption, told); mark(drawing, "aria-label", told);
  }];
};
const section = (title, ...children) => el("section", {}, el("h3", {}, title), ...children);
const notes = () => { const node = el("ul"); return [node, (values) => { const told = values.filter(Boolean); if (node.dataset.told !== told.join("\n")) { node.dataset.told = told.join("\n"); node.replaceChildren(...told.map((one) => el("li", {}, one))); } node.hidden = !told.length; }]; };

const LABELS = { handover: "Hand over…", failback: "Fail back…", prefer: "Prefer a robot…", promote: "Promote…", stop: "Stop…", start: "Start…", reserve: "Reserve…", unreserve: "End reservation…", release: "Release…" };
const componentView = (name) => {
  const key = `component:${name}`, [head, setHead] = heading(), [list_, setFacts] = facts(), [notes_, setNotes] = notes(), promise = el("p");
  const [lag, drawLag] = chart(key, 0, "Age of the checkpoint at the standby", ms), [freeze, drawFreeze] = chart(key, 1, "Freeze for a snapshot", ms);
  const buttons = el("div", { class: "buttons", role: "group", "aria-label": "Orders" }), made = {};
  for (const verb of Object.keys(LABELS)) buttons.append(made[verb] = el("button", { type: "button", onclick: () => made[verb].getAttribute("aria-disabled") === "true" ? say(made[verb].title, true) : confirmOrder(name, verb) }, LABELS[verb]));
  const told = el("ol", { class: "story" }), silent = el("p", { class: "quiet" });
  const out = el("pre", { tabindex: "0", role: "group", "aria-label": "Standard output" }), err = el("pre", { tabindex: "0", role: "group", "aria-label": "Standard error" }), outSays = el("p", { class: "quiet" });
  const tasks = tableOf(["Task", "State", "Period", "Misses", "Late, half / 99 of 100 below", "Took, half / 99 of 100 below"]);
  const taskPart = section("Tasks", tasks.node);
  let shown = "";
  return { key, node: [el("h2", {}, name), head, promise, buttons, list_, notes_, section("The last ten minutes", el("div", { class: "charts" }, lag, freeze)), taskPart, section("What was decided", silent, told), section("Output", outSays, out, err)], update() {
    const one = table.get(key);
    if (!one) return setHead("unknown", "It is not here any more, or you may not see it.");
    setHead(one.word, one.why);
    set(promise, one.promise || "");
    setFacts([["Runs at", one.primary], ["Stands by", one.standby ? `${one.standby}${one.ready || one.warm ? ", ready" : ""}` : "no robot"], ["State", one.state], ["Epoch", one.epoch],
      ["Newest checkpoint", one.generation == null ? null : `${one.generation}.${one.sequence}, ${ms(one.lag_ms)} old`], ["Freeze", one.engine === "cooperative" ? "never" : one.freeze_us == null ? null : `${ms(one.freeze_us / 1000)}, at most ${ms(one.freeze_us_max / 1000)}`],
      ["Snapshot", one.snapshot_size == null ? null : `${size(one.snapshot_size)} every ${one.period_ms} ms`], ["Started at; prefers", [one.home, one.prefer].filter(Boolean).join("; ")],
      ["Last takeover", one.outage_ms == null ? null : `stood still for ${ms(one.outage_ms)}`], ["Kept here", one.kept ? `${one.kept.checkpoints} checkpoints, ${size(one.kept.size)}` : null], ["Reserved", one.reserved && `by ${one.reserved.user} until ${clock(new Date(one.reserved.until * 1000))}${one.reserved.why ? `: ${one.reserved.why}` : ""}`], ["Exit status", one.exit_status]]);
    setNotes([...(one.lacks || []), ...(one.notes || [])]);
    for (const [verb, button] of Object.entries(made)) { const order = one.orders?.[verb]; mark(button, "aria-disabled", String(!order || !!order.why_not)); mark(button, "title", order?.why_not || order?.says || ""); button.hidden = !order; }
    drawLag(); drawFreeze();
    const own = rows("task").filter(([, task]) => task.component === name).sort(compare);
    taskPart.hidden = !own.length;
    tasks.fill(own.map(([task, t]) => [task, [task, t.state, ms(t.period_ns / 1e6), String(t.misses), `${ms(t.late_p50_ns / 1e6)} / ${ms(t.late_p99_ns / 1e6)}`, `${ms(t.took_p50_ns / 1e6)} / ${ms(t.took_p99_ns / 1e6)}`]]));
    const heard = story.get(name);
    if (heard && shown !== JSON.stringify(heard)) { shown = JSON.stringify(heard); told.replaceChildren(...[...heard.lines].reverse().map(decision)); set(silent, [heard.says, heard.silent.length ? `No answer from ${heard.silent.join(", ")}.` : ""].join(" ").trim()); }
    const text = output.get(name) || { 1: "", 2: "", says: "" };
    for (const [pre, stream] of [[out, 1], [err, 2]]) { const low = pre.scrollTop + pre.clientHeight >= pre.scrollHeight - 4; set(pre, text[stream]); pre.hidden = !text[stream] && stream === 2; if (low) pre.scrollTop = pre.scrollHeight; }
    set(outSays, text.says);
  } };
};
const decision = (line) => {
  const when = new Date(line.at * 1000), turn = line.epoch_before !== line.epoch;
  const known = [line.component && `epoch ${turn ? `${line.epoch_before} → ` : ""}${line.epoch}`, line.state, line.checkpoint_age_ms == null ? "" : `checkpoint ${ms(line.checkpoint_age_ms)} old`, line.repeats ? `said ${line.repeats + 1} times` : "",
    ...line.seen.map((peer) => `${peer.robot} ${peer.state}, heard ${ms(Math.round(peer.silent_ms))} ago`), line.doubt_ms >= 1 ? `time known within ${ms(line.doubt_ms)}` : ""];
  return el("li", { class: turn ? "turn" : null }, el("time", { datetime: when.toISOString() }, `${clock(when)}.${String(when.getMilliseconds()).padStart(3, "0")}`), el("span", { class: "by" }, line.robot), line.did, el("span", { class: "facts" }, known.filter(Boolean).join(" · ")));
};
const tableOf = (columns, kind = "") => {
  const body = el("tbody"), node = el("div", { class: `scroll ${kind}`, tabindex: "0", role: "region", "aria-label": `${columns[0]}s` }, el("table", { class: kind ? null : "facts" }, el("thead", {}, el("tr", {}, ...columns.map((one) => el("th", { scope: "col" }, one)))), body)), made = new Map();
  return { node, fill(wanted) {
    wanted.forEach(([key, cells], place) => {
      if (!made.has(key)) made.set(key, el("tr", {}, ...cells.map((_, index) => index ? el("td") : el("th", { scope: "row" }))));
      const row = made.get(key);
      cells.forEach((cell, index) => typeof cell === "string" ? set(row.children[index], cell) : cell(row.children[index]));
      if (body.children[place] !== row) body.insertBefore(row, body.children[place] || null);
    });
    const keys = new Set(wanted.map(([key]) => key));
    for (const [key, row] of made) if (!keys.has(key)) { row.remove(); made.delete(key); }
  } };
};
const teamView = () => {
  const [list_, setFacts] = facts(), [notes_, setNotes] = notes();
  const all = tableOf(["Component", "Safety", "Runs at", "Stands by", "Epoch", "Checkpoint", "Freeze"]);
  return { key: "team", node: [el("h2", {}, "The team"), all.node, section("This robot", list_, notes_)], update() {
    const team = table.get("team") || {};
    all.fill(rows("component").sort(compare).map(([name, one]) => [name, [(cell) => { if (!cell.firstChild) cell.append(el("a", { href: link("component", name) }, name)); }, (cell) => { set(cell, `${sign(one.word)[0]} ${one.word}`); mark(cell, "class", sign(one.word)[1]); }, one.primary || "–", one.standby || "–", String(one.epoch), ms(one.lag_ms), one.freeze_us == null ? "–" : ms(one.freeze_us / 1000)]]));
    setFacts([["Robot", team.robot], ["Rule", team.rule], ["Fencing", team.fencing], ["Rights", team.rights || "without rights.toml: owners and root"], ["Keys", team.insecure ? "none: links are neither authenticated nor encrypted" : "links are authenticated and encrypted"], ["Version", team.version]]);
    setNotes(team.notes || []);
  } };
};
const robotView = (name) => {
  const key = `robot:${name}`, [head, setHead] = heading(), [list_, setFacts] = facts(), [notes_, setNotes] = notes();
  return { key, node: [el("h2", {}, name), head, list_, notes_], update() {
    const one = table.get(key) || {};
    setHead(one.state || "unknown", one.here ? "the robot of this page" : one.silent_s ? `silent for ${one.silent_s} s` : "");
    setFacts(one.here ? [["Role", one.role], ["Starts of its agent", one.life], ["Heartbeats refused", one.refused], ["Links", list(Object.entries(one.carriers || {}).map(([link_, told]) => `${link_}: ${told}`))]]
      : [["Role", one.role], ["Hears this robot", one.hears_us ? "yes" : "no"], ["Heard over", list(one.links || [])], ["Replication link", one.lane], ["Heartbeats lost", one.beats_lost], ["Load", one.load]]);
    setNotes(one.notes || []);
  } };
};
const taskView = (name) => {
  const key = `task:${name}`, [list_, setFacts] = facts();
  return { key, node: [el("h2", {}, name), list_], update() {
    const one = table.get(key) || {};
    setFacts([["State", one.state], ["Component", one.component], ["Period", ms((one.period_ns || 0) / 1e6)], ["Activations", one.started], ["Deadlines missed", one.misses], ["Overruns", one.overruns], ["Half began within", ms((one.late_p50_ns || 0) / 1e6)], ["99 of 100 began within", ms((one.late_p99_ns || 0) / 1e6)], ["After", list(one.after || [])]]);
  } };
};
const boardView = () => {
  const robots = [...new Set(rows("item").map(([, one]) => one.robot))].sort(), items = tableOf(["Item", ...robots], "board"), none = el("p", {}, "This robot has no board, or the page's user may not read it.");
  return { key: "", robots: robots.join(), node: [el("h2", {}, "The board"), none, items.node], update() {
    const all = rows("item"), names = [...new Set(all.map(([, one]) => one.item))].sort(), now = [...new Set(all.map(([, one]) => one.robot))].sort();
    if (now.join() !== this.robots) return show();
    none.hidden = !!all.length; items.node.hidden = !all.length;
    items.fill(names.map((item) => [item, [item, ...robots.map((robot) => (cell) => drawItem(cell, table.get(`item:${robot}/${item}`), link("item", `${robot}/${item}`)))]]));
  } };
};
const drawItem = (cell, one, href) => {
  if (!one) return set(cell, "–");
  if (!cell.querySelector("a")) cell.replaceChildren(el("a", { href }), el("br"), el("meter", { min: "0", max: "1", high: "0.99", "aria-hidden": "true" }), " ", el("span", { class: "quiet" }));
  const [value, , meter, age] = cell.children;
  set(value, one.complaint || (one.put ? JSON.stringify(one.value).slice(0, 80) : "never put"));
  meter.hidden = !one.bound_ms || one.age_ms == null; meter.value = one.bound_ms ? Math.min(one.age_ms / one.bound_ms, 1) : 0;
  set(age, one.age_ms == null ? "" : `${one.stale ? "stale, " : ""}${ms(one.age_ms)}${one.bound_ms ? ` of ${ms(one.bound_ms)}` : ""}`); mark(age, "class", one.stale ? "bad" : "quiet");
};
const itemView = (name) => {
  const key = `item:${name}`, [list_, setFacts] = facts(), [curve, drawCurve] = chart(key, 0, "Value", (value) => String(value));
  return { key, node: [el("h2", {}, name), list_, curve], update() {
    const one = table.get(key) || {};
    setFacts([["Value", one.complaint || JSON.stringify(one.value)], ["Type", one.type], ["Age", ms(one.age_ms)], ["At most", ms(one.age_max_ms)], ["Bound", one.bound_ms ? ms(one.bound_ms) : "none"], ["Puts", one.put], ["Frames lost", one.lost]]);
    curve.hidden = typeof one.value !== "number"; drawCurve();
  } };
};

// --- A radio: who speaks when in the round, as this robot hears it ---------------------------------------------------------
const OFF_MS = 1;   // a frame that is farther from its slot is one that the reference follows, or a fault
const radioView = (wanted) => {
  const all = rows("medium"), name = wanted || (all.find(([, one]) => one.own) || all[0] || [""])[0], key = `medium:${name}`;
  const media = tableOf(["Link", "Frames leave", "Every", "Robots", "Besides"]), members = tableOf(["Robot", "State", "Slot begins", "Came", "Jitter", "Lost", "Hears", "Traffic"]);
  const [head, setHead] = heading(), [list_, setFacts] = facts(), [notes_, setNotes] = notes(), [ring, drawRing] = ringOf();
  const [round, drawRound] = chart(key, 0, "Round", tenths), [count, drawCount] = chart(key, 1, "Robots in the round", String), charts = section("The last ten minutes", el("div", { class: "charts" }, round, count));
  const share = trafficOf();
  return { key, node: [el("h2", {}, "Links and radio"), media.node, section(name || "No link", head, el("div", { class: "radio" }, ring, list_), notes_, members.node), charts], update() {
    if (!name && rows("medium").length) return show();
    const one = table.get(key), slots = !!one?.own;
    media.fill(rows("medium").sort(compare).map(([link_, m]) => [link_, [(cell) => { if (!cell.firstChild) cell.append(el("a", { href: link("medium", link_) }, link_)); }, `by ${m.cast}${m.because ? `: ${m.because}` : ""}`, ms(m.period_ms), m.own ? String(m.count) : "no slots", m.no_slots || (m.by_unicast.length ? `by unicast to ${list(m.by_unicast)}` : "")]]));
    list_.hidden = ring.hidden = charts.hidden = !slots;
    if (!one) return setHead("unknown", "There is no such link.");
    const [word, why] = !slots ? ["at once", `frames wait for no slot here, they leave every ${ms(one.period_ms)}`] : [one.own, one.why || (one.own === "running" ? "this robot has a slot" : "this robot speaks without a slot")];
    setHead(word, why);
    const own = rows("member").filter(([, m]) => m.medium === name).map(([, m]) => m).sort((a, b) => (a.place ?? 99) - (b.place ?? 99) || order.compare(a.robot, b.robot)), [part, rate] = share(own);
    members.fill(own.map((m) => [m.robot, memberCells(m, one, part(m))]));
    setNotes((one.deaf || []).map(([listener, speaker]) => `${listener} does not hear ${speaker}`));
    if (!slots) return;
    drawRing(one, own.filter((m) => m.place != null)); drawRound(); drawCount();
    setFacts([["Round", `${tenths(one.round_ms)}, planned ${ms(one.period_ms)}`], ["Robots in it", one.count], ["Reference", one.reference], ["Rounds of this robot", one.round], ["Rounds that it stretched", one.followed], ["Delays not followed", one.outside],
      ["Least gap", tenths(one.least_gap_ms)], ["This robot was late by", `${ms(one.late_ms)}, at most ${ms(one.late_ms_max)}`], ["Frames of another round", one.ignored], ["Traffic of all", rate]]);
  } };
};
const trafficOf = () => {   // bytes of the last ten seconds
  const samples = [];
  return (own) => {
    const now = performance.now() / 1000, bytes = new Map(own.map((m) => [m.robot, m.bytes]));
    if (!samples.length || now - samples.at(-1)[0] >= 1) samples.push([now, bytes]);
    while (samples.length > 1 && now - samples[0][0] > 10) samples.shift();
    const [began, before] = samples[0], more = (m) => Math.max(m.bytes - (before.get(m.robot) ?? m.bytes), 0), all = own.reduce((sum, m) => sum + more(m), 0);
    const told = now - began >= 1 && all;
    return [(m) => told ? `${Math.round(100 * more(m) / all)} %` : "–", told ? `${size(all / (now - began))}/s` : "–"];
  };
};
const SEEN = { run: ["●", "in its slot", "good"], insert: ["○", "joins", "quiet"], remove: ["✕", "missed", "bad"], not: ["–", "no slot", "quiet"] };
const off = (m) => `${m.offset_ms < 0 ? "−" : "+"}${ms(Math.abs(m.offset_ms))}`;
const memberCells = (m, medium, part) => {
  const [icon, word, kind] = SEEN[m.place != null && m.seen === "not" ? "remove" : m.seen] || ["", "", "quiet"], placed = m.place != null, others = (medium.members || []).filter((robot) => robot !== m.robot), deaf = others.filter((robot) => !m.hears?.includes(robot));
  const state = [m.robot === medium.reference && placed ? "reference" : "", m.here ? "this robot" : "", m.missed ? `missed ${m.missed} rounds` : word].filter(Boolean).join(", ");
  return [m.robot, (cell) => { set(cell, `${icon} ${state}`.trim()); mark(cell, "class", kind); }, placed ? tenths(m.planned_ms) : "–", placed && m.seen !== "not" ? off(m) : "–", placed ? ms(m.jitter_ms) : "–", m.here || !m.awaited ? "–" : `${m.lost} of ${m.awaited}`,
    !placed || m.seen === "not" ? "–" : !others.length ? "no other" : deaf.length ? `not ${list(deaf)}` : "all", part];
};
const ringOf = () => {
  const drawing = el("svg", { class: "ring", viewBox: "0 20 480 360", role: "img" }), caption = el("figcaption");
  let drawn = "";
  return [el("figure", {}, drawing, caption), (medium, own) => {
    const told = JSON.stringify([medium, own]);
    if (told === drawn) return;
    drawn = told;
    const at_ = (turn, radius) => [240 + radius * Math.sin(2 * Math.PI * turn), 200 - radius * Math.cos(2 * Math.PI * turn)].map((one) => one.toFixed(1));
    const line = (kind, from, to) => el("line", { class: kind, x1: from[0], y1: from[1], x2: to[0], y2: to[1] }), count = medium.count, turns = new Map(own.map((m) => [m.robot, m.place / count]));
    const text = (kind, [x, y], said, anchor = "middle") => el("text", { class: kind, x, y, "text-anchor": anchor, "dominant-baseline": "middle" }, said), parts = [el("circle", { class: "band", cx: 240, cy: 200, r: 130 })];
    for (const [listener, speaker] of medium.deaf || []) if (turns.has(listener) && turns.has(speaker)) parts.push(line("deaf", at_(turns.get(listener), 112), at_(turns.get(speaker), 112)));
    for (const m of own) {
      const turn = m.place / count, came = turn + m.offset_ms / medium.period_ms, side = Math.sin(2 * Math.PI * turn), [x, y] = at_(came, 130), missed = m.seen === "remove" || m.seen === "not";
      parts.push(line("planned", at_(turn, 112), at_(turn, 150)));
      if (missed) parts.push(text("bad", at_(turn, 130), "✕"));
      else parts.push(Math.abs(m.offset_ms) > OFF_MS ? el("path", { class: "warn", d: `M${x} ${+y - 8}l8 14h-16z` }) : el("circle", { class: m.here ? "came own" : "came", cx: x, cy: y, r: 7 }));
      if (count <= 24 || m.here || m.robot === medium.reference) parts.push(text(m.here ? "here" : null, at_(turn, 164), m.robot.length > 14 ? `${m.robot.slice(0, 13)}…` : m.robot, side > 0.2 ? "start" : side < -0.2 ? "end" : "middle"));
    }
    parts.push(text("large", [240, 190], tenths(medium.round_ms)), text(null, [240, 214], `K = ${medium.count}`));
    drawing.replaceChildren(...parts);
    mark(drawing, "aria-label", `The round of ${medium.link}, ${tenths(medium.round_ms)}, begins at ${medium.reference}: ${own.map((m) => `${m.robot} at ${tenths(m.planned_ms)}, ${m.seen === "remove" || m.seen === "not" ? "missed" : `came ${off(m)}`}`).join("; ")}`);
    set(caption, `One round, clockwise from the reference. A line: its slot begins; ● its frame, ▲ more than ${ms(OFF_MS)} beside the line, ✕ none. Dashed: one does not hear the other.`);
  }];
};
const ordersView = () => {
  const all = tableOf(["Number", "At", "User", "Order", "State", "Result"]);
  return { key: "", node: [el("h2", {}, "Orders on this page"), all.node], update() {
    all.fill(rows("order").sort((a, b) => b[1].number - a[1].number).map(([, one]) => [one.number, [String(one.number), clock(new Date(one.at * 1000)), one.user, `${one.verb} ${one.name} ${one.what}`, one.state, [one.says, one.took_ms == null ? "" : `(${ms(one.took_ms)})`].join(" ")]]));
  } };
};
const driverView = (path) => {
  const key = `driver:${path}`, [list_, setFacts] = facts(), forms = el("div"), why = el("p", { class: "bad" });
  for (const [verb, said] of Object.entries(table.get(key)?.verbs || {}).filter(([, one]) => one.role !== "stream")) {
    const inputs = Object.entries(said.arguments || {}).map(([name, schema]) => [name, schema, inputOf(name, schema)]);
    forms.append(el("form", { onsubmit: (event) => { event.preventDefault(); callDriver(path, verb, inputs); } }, el("h3", {}, `${verb} (${said.role})`), ...inputs.map(([name, schema, input]) => el("label", {}, `${name}${rangeOf(schema)}`, input)), el("button", { type: "submit" }, verb)));
  }
  return { key, node: [el("h2", {}, path), list_, why, forms], update() {
    const one = table.get(key) || {};
    setFacts([["Robot", one.kind === "simulated" ? `${one.robot}, which simulates it` : one.robot], ["Reach", one.reach], ["Also called", list(one.aliases || [])], ["Versions", list(one.versions || [])]]);
    set(why, one.refused || one.why_not || ""); forms.hidden = !!one.why_not;
  } };
};
const rangeOf = (schema) => [schema.minimum, schema.maximum].some((one) => one != null) ? `, from ${schema.minimum ?? "–"} to ${schema.maximum ?? "–"}` : "";
const inputOf = (name, schema) => schema.enum ? el("select", {}, ...schema.enum.map((one) => el("option", {}, String(one)))) : schema.type === "boolean" ? el("input", { type: "checkbox" })
  : schema.type === "number" || schema.type === "integer" ? el("input", { type: "number", step: schema.type === "integer" ? "1" : "any", min: schema.minimum, max: schema.maximum, required: true }) : el("input", { type: "text", placeholder: schema.type === "string" ? "" : "JSON" });
const valueOf = (schema, input) => input.type === "checkbox" ? input.checked : input.type === "number" ? Number(input.value) : schema.type === "string" || schema.enum ? input.value : JSON.parse(input.value);
const callDriver = (path, verb, inputs) => {
  try { give({ verb: "call", name: path, call: verb, body: inputs.length ? Object.fromEntries(inputs.map(([name, schema, input]) => [name, valueOf(schema, input)])) : null }); } catch (error) { say(`That is not JSON: ${error.message}`, true); }
};

// --- Orders -------------------------------------------------------------------------------------------------------------------
const ORDER_MS = 15000;   // an order is taken within this time, or not at all
const post = async (path, body, limit = 15000) => {
  const answer = await fetch(path, { method: "POST", signal: AbortSignal.timeout(limit), headers: { "content-type": "application/json", "x-failover-token": session?.token || "" }, body: JSON.stringify(body) });
  return [answer.status, await answer.json()];
};
let given = Promise.resolve();
const give = (wish) => {   // one after the other: none overtakes an earlier one
  const order = { ...wish, id: crypto.randomUUID(), boot: session.boot }, since = performance.now();
  mine.add(order.id);
  given = given.then(() => giveNow(order, since));
};
const giveNow = async (order, since) => {
  for (let sent = false, why = "there was no time for it";;) {
    const age_ms = performance.now() - since, unknown = sent ? "; whether it was carried out is not known: look at the team" : "";
    if (age_ms > ORDER_MS) return notGiven(order, `${why}; it is not sent again${unknown}`);
    let status, said;
    try { [status, said] = await post("/orders", { ...order, age_ms }, 5000); } catch { sent = true; [status, said] = [0, { error: "no answer came", again_ms: 1000 }]; }   // sent again with its ID: it is carried out once
    if (status === 202) return;
    if (!said.again_ms) return notGiven(order, `${said.error}${unknown}`);
    why = said.error;
    await new Promise((done) => setTimeout(done, said.again_ms));
  }
};
const notGiven = (order, why) => { mine.delete(order.id); say(`${order.verb} ${short(order.name)}: ${why}`, true); };
const tellOrder = (order) => { if (order.state === "done" || order.state === "refused") { mine.delete(order.id); say(`${order.verb} ${short(order.name)}: ${order.says || "done"}`, order.state === "refused"); } };
const say = (text, bad = false) => { const told = el("p", { class: bad ? "bad" : null }, text); at("said").append(told); setTimeout(() => told.remove(), bad ? 20000 : 8000); };
const confirmOrder = async (name, verb) => {
  const key = `component:${name}`, seen = table.get(key), order = seen.orders[verb], box = at("dialog");
  const to = order.to ? el("select", {}, ...order.to.map((robot) => el("option", { value: robot }, robot || "the one with the newest checkpoint"))) : null;
  let robot = order.target || "";
  const minutes = order.asks && el("input", { type: "number", min: 1, max: 240, value: 10, required: true }), why = order.asks && el("input", { type: "text", maxlength: 120, required: true });
  const body = () => minutes ? { body: { span_ms: 60000 * minutes.value, why: why.value } } : {};
  const [risks_, setRisks] = notes(), changed = el("p", { class: "warn", role: "status" }), act = el("button", { type: "submit", class: "main" }, LABELS[verb].replace("…", ""));
  const ask = async () => {   // what is at risk depends on the robot, so the order names the one of which it was told
    if (verb !== "promote") return;
    const wanted = to.value;
    act.disabled = true;
    const [, said] = await post("/risks", { name, robot: wanted }).catch(() => [0, { error: "No answer came: choose again." }]);
    if (to.value !== wanted) return;
    robot = said.to; act.disabled = !!said.error;
    setRisks([said.error || said.sentence, ...(said.risks || [])]);
  };
  to?.addEventListener("change", ask);
  box.replaceChildren(el("form", { onsubmit: (event) => { event.preventDefault(); box.close(); give({ verb, name, to: verb === "promote" ? robot : to ? to.value : robot, epoch: seen.epoch || 0, ...body() }); } },
    el("h2", { id: "asked" }, `${LABELS[verb].replace("…", "")}: ${name}`), el("p", {}, order.says), risks_, to && el("label", {}, "Robot", to), minutes && el("label", {}, "Minutes", minutes), why && el("label", {}, "Why", why), changed, el("div", { class: "buttons" }, act, el("button", { type: "button", onclick: () => box.close() }, "Cancel"))));
  setRisks([]); box.showModal(); (to || minutes || act).focus(); ask();
  const watch = setInterval(() => { const now = table.get(key); if (!box.open) clearInterval(watch); else if (now?.epoch !== seen.epoch) set(changed, `It has changed meanwhile: epoch ${seen.epoch} → ${now?.epoch}, it runs at ${now?.primary}. This order will be refused; cancel, and look again.`); }, 200);
};

// --- Where we are, and the connection ---------------------------------------------------------------------------------------------
const VIEWS = { component: componentView, robot: robotView, task: taskView, driver: driverView, item: itemView, medium: radioView };
const show = () => {
  const [, kind, name] = location.hash.split("/"), told = decodeURIComponent(name || "");
  view = kind === "board" ? boardView() : kind === "radio" ? radioView("") : kind === "orders" ? ordersView() : VIEWS[kind] && told ? VIEWS[kind](told) : teamView();
  at("main").replaceChildren(...view.node);
  const current = { item: "board", medium: "radio" }[kind] || (["board", "radio", "orders"].includes(kind) ? kind : "");
  for (const one of at("views").children) one.hash.slice(2) === current ? mark(one, "aria-current", "page") : one.removeAttribute("aria-current");
  look(); draw();
};
const look = () => { output.clear(); if (socket?.readyState === 1) socket.send(JSON.stringify({ look: view?.key && view.key !== "team" ? view.key : "" })); };
addEventListener("hashchange", () => { if (location.hash.startsWith("#/")) { show(); } });
at("skip").addEventListener("click", (event) => { event.preventDefault(); at("main").focus(); });

at("logout").addEventListener("click", async () => { await post("/logout", {}).catch(() => 0); location.reload(); });

const login = () => {
  view = null;
  const name = el("input", { autocomplete: "username", required: true }), password = el("input", { type: "password", autocomplete: "current-password", required: true }), why = el("p", { class: "bad", role: "alert" });
  at("main").replaceChildren(el("h2", {}, "Log in"), el("form", { onsubmit: async (event) => { event.preventDefault(); const [status, said] = await post("/login", { name: name.value, password: password.value }); if (status !== 200) return set(why, said.error); session = said; at("logout").hidden = false; connect(); } }, el("label", {}, "Name", name), el("label", {}, "Password", password), el("button", { type: "submit", class: "main" }, "Log in")), why);
  name.focus();
};
const begin = async () => {
  try {
    const answer = await fetch("/session"), said = await answer.json();
    if (answer.status === 401) return login();
    if (!answer.ok) throw new Error(said.error);
    session = said; at("logout").hidden = !said.login; connect();
  } catch (error) { away(lost = `This page does not reach its server: ${error.message}.`); setTimeout(begin, wait = Math.min(wait * 2, 5000)); }
};
const connect = () => {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  let fresh = true;
  socket.onmessage = (event) => { const message = JSON.parse(event.data); if (message.hello) { wait = 500; return; } if (!fresh) return take(message); fresh = false; lost = ""; table.clear(); take(message); view ? look() : show(); };
  socket.onclose = (event) => { away(lost = event.reason ? `The server has ended the connection: ${event.reason}.` : "The connection to the page's server is lost; it is tried again."); setTimeout(begin, wait = Math.min(wait * 2, 5000)); };
};
begin();
