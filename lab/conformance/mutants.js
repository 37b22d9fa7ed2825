// node mutants.js READER WIRE.JSON VECTORS < [[before, after], …]: the numbers of the changes to the reader that pass all
// vectors. All in one process: a reader is stopped at the first vector that it fails, and after ten times
// what the reader itself takes.
const fs = require("fs");
const vm = require("vm");

const [reader, schema, vectors] = process.argv.slice(2);
const text = fs.readFileSync(reader, "utf-8");
const files = new Map();
const cached = { readFileSync: (path) => files.get(path) ?? files.set(path, fs.readFileSync(path, "utf-8")).get(path) };

function passes(code, timeout) {
  const end = {};
  let passed = false;
  const world = {
    TextDecoder, TextEncoder,
    require: () => cached,
    console: { log: (line) => { if (!/^\S+: (\d+) of \1$/.test(line)) throw end; } },
    process: { argv: ["", "", schema, vectors], exit: (status) => { passed = status === 0; throw end; } },
  };
  try {
    vm.runInNewContext(code, world, { timeout });
  } catch (error) {
    return passed;
  }
  return passed;
}

const began = Date.now();
if (!passes(text)) throw new Error("the reader itself does not pass the vectors");
const most = 5000 + 10 * (Date.now() - began);
const changes = JSON.parse(fs.readFileSync(0, "utf-8"));
const survivors = changes.flatMap(([before, after], number) => (passes(text.replace(before, () => after), most) ? [number] : []));
console.log(JSON.stringify(survivors));
