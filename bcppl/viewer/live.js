// A page that is served while a belief is computed: each further step is appended once it is there.

let due = false;

function follow(entry) {
  const along = state.step === labels.length - 1, armed = held.measurements.some((each) => each.arm);
  append(entry);
  element("step").max = labels.length - 1;
  if (along) [state.step, state.moment] = [labels.length - 1, null];
  if (!due) requestAnimationFrame(() => {
    due = false;
    keys();
    update();
  });
  due = true;
  if (!armed && entry.measurement.arm) overview(); // which showed the part alone
}

function status(text) {
  element("live").textContent = document.documentElement.dataset.live = text;
}

if (held.live) {
  const source = new EventSource("events");
  source.onopen = () => status("live");
  source.onmessage = (event) => follow(unpacked(JSON.parse(event.data)));
  source.onerror = () => status("not connected"); // it asks again by itself
  source.addEventListener("end", () => {
    source.close();
    status("ended");
  });
}
