// SPDX-License-Identifier: GPL-3.0-or-later
// Reads what a model says of itself: ONNX Runtime's JavaScript does not show the metadata of a file.

const GRAPH_METADATA = 14; // field metadata_props of ModelProto, onnx.proto
const KEY = 1;
const VALUE = 2;

/**
 * The joints, controls, … of a model: the JSON of its metadata property `fdda`, docs/formats.md.
 *
 * @param {Uint8Array} bytes the .onnx file
 * @throws {Error} it is no FDDA model of version 1
 */
export function readInfo(bytes) {
  const info = JSON.parse(properties(bytes).get("fdda") ?? "{}");
  if (info.version !== 1) throw new Error("model.onnx is no FDDA model of version 1; prepare the page with one.");
  return info;
}

function properties(bytes) {
  const text = new TextDecoder();
  const found = new Map();
  for (const [number, entry] of fields(bytes)) {
    if (number !== GRAPH_METADATA) continue;
    const pair = new Map(fields(entry));
    found.set(text.decode(pair.get(KEY)), text.decode(pair.get(VALUE)));
  }
  return found;
}

/** The fields of a protobuf message: number, and the bytes of those that have a length. */
function* fields(bytes) {
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let factor = 1; at < bytes.length; factor *= 128) {
      const byte = bytes[at++];
      value += (byte & 127) * factor;
      if (byte < 128) return value;
    }
    throw new Error("model.onnx ends in the middle; prepare the page again.");
  };
  while (at < bytes.length) {
    const tag = varint();
    const skip = { 0: () => void varint(), 1: () => (at += 8), 5: () => (at += 4) }[tag & 7];
    if (skip) {
      skip();
      continue;
    }
    const length = varint();
    if ((tag & 7) !== 2 || at + length > bytes.length)
      throw new Error("model.onnx is no ONNX file; prepare the page again.");
    yield [tag >>> 3, bytes.subarray(at, at + length)];
    at += length;
  }
}
