// What the browser decides by itself: whether a pointer paints, pulls or turns the view, and what keys do.
(() => {
  const me = crypto.randomUUID(); // one window of perhaps several
  const letters = { k: "knee", r: "best-regularity", p: "best-improvement-potential", b: "paint", g: "pull", v: "view" };
  const arrows = { ArrowLeft: "left", ArrowRight: "right" };
  const BRUSH = ["action", "radius", "strength", "edge", "direction"];
  let gesture = null;

  const ask = (name, ...values) => window.trame.trigger(name, values);
  const stage = () => document.getElementById("stage");

  /** Where an event is on the stage: (0, 0) is the upper left corner, (1, 1) the lower right one. */
  function place(event) {
    const box = stage().getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  }

  /** Let the view have what a pointer did that the server has no use for, as if it happened now. */
  function replay({ target, events }) {
    const copied = ["pointerId", "pointerType", "isPrimary", "button", "buttons", "clientX", "clientY", "screenX", "screenY", "pressure"];
    for (const event of events) {
      const made = new PointerEvent(event.type, { bubbles: true, cancelable: true, ...Object.fromEntries(copied.map((name) => [name, event[name]])) });
      made.replayed = true;
      target.dispatchEvent(made);
    }
  }

  /** Send what has happened since the last answer, in order, until nothing is left. */
  async function send(current) {
    if (current.sending || !current.mine) return;
    current.sending = true;
    while (current.places.length) {
      await ask("drag", me, current.places.splice(0));
      window.rbfevoStudio.answered += 1;
    }
    if (current.over) {
      await ask("release", me);
      end(current);
    }
    current.sending = false;
  }

  /** A gesture has come to its end, and the next one may begin. */
  function end(current) {
    if (gesture === current) gesture = null;
    current.finish();
  }

  async function press(event) {
    if (event.replayed || event.button !== 0 || event.ctrlKey || event.shiftKey || event.altKey || event.metaKey || !event.target.closest?.("#stage")) return;
    event.stopImmediatePropagation();
    const box = stage().getBoundingClientRect(), before = gesture?.finished;
    const current = (gesture = { id: event.pointerId, target: event.target, events: [event], places: [], mine: false, sending: false, over: false });
    current.finished = new Promise((done) => { current.finish = done; });
    await before; // on a busy machine the server may still be at the last stroke
    try {
      const brush = Object.fromEntries(BRUSH.map((name) => [name, window.trame.state.get(name)])); // which may not have been sent yet
      current.mine = await ask("press", me, brush, window.trame.refs.view.getCamera(), ...place(event), box.width / box.height);
    } catch { /* the connection is gone, and the page says so */ }
    if (current.mine) send(current);
    else {
      end(current);
      replay(current);
    }
  }

  function drag(event) {
    if (event.replayed || !gesture || event.pointerId !== gesture.id) return;
    event.stopImmediatePropagation();
    if (!gesture.mine) gesture.events.push(event);
    const events = event.getCoalescedEvents?.() || [];
    gesture.places.push(...(events.length ? events : [event]).map(place));
    send(gesture);
  }

  function release(event) {
    if (event.replayed || !gesture || event.pointerId !== gesture.id) return;
    event.stopImmediatePropagation();
    if (!gesture.mine) gesture.events.push(event);
    gesture.over = true;
    send(gesture);
  }

  document.addEventListener("pointerdown", press, true);
  document.addEventListener("pointermove", drag, true);
  document.addEventListener("pointerup", release, true);
  document.addEventListener("pointercancel", release, true);
  window.addEventListener("blur", () => { if (gesture) { gesture.over = true; send(gesture); } });

  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest?.("input[type=text], input[type=number], select, textarea, dialog");
    const command = (event.ctrlKey || event.metaKey) && !event.altKey;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    let what = null;
    if (command && !typing) what = key === "z" ? (event.shiftKey ? "redo" : "undo") : key === "y" ? "redo" : null;
    else if (!command && !event.altKey && !typing) what = (!event.target.closest?.("input") && arrows[key]) || (document.getElementById("letters")?.checked ? letters[key] : null);
    if (key === "?" && !typing) document.getElementById("keys")?.showModal();
    if (!what) return;
    event.preventDefault();
    ask("key", what);
  });

  window.rbfevoStudio = { answered: 0 }; // drags that the server has answered, for measurements
})();
