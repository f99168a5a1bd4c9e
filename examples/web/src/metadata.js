// SPDX-License-Identifier: GPL-3.0-or-later
// Reads the metadata of a model: the JavaScript API of ONNX Runtime has no access to it.

const GRAPH_METADATA = 14; // field metadata_props of ModelProto, onnx.proto
const KEY = 1;
const VALUE = 2;

/**
 * Read the JSON of a model's metadata property `fdda`, which docs/formats.md describes.
 *
 * @param {Uint8Array} bytes the .onnx file
 * @throws {Error} the file is not an FDDA model of version 1
 */
export function readInfo(bytes) {
  const info = JSON.parse(readProperties(bytes).get("fdda") ?? "{}");
  if (info.version !== 1) throw new Error("model.onnx is not an FDDA model of version 1; run prepare.py with one.");
  return { ...info, vertexCount: info.meshes.reduce((sum, { vertices }) => sum + vertices, 0) };
}

function readProperties(bytes) {
  const decoder = new TextDecoder();
  const values = new Map();
  for (const [number, entry] of fields(bytes)) {
    if (number !== GRAPH_METADATA) continue;
    const pair = new Map(fields(entry));
    values.set(decoder.decode(pair.get(KEY)), decoder.decode(pair.get(VALUE)));
  }
  return values;
}

/** Yield the number and the bytes of each field of a protobuf message that has a length; skip other fields. */
function* fields(bytes) {
  let offset = 0;
  const readVarint = () => {
    let value = 0;
    for (let factor = 1; offset < bytes.length; factor *= 128) {
      const byte = bytes[offset++];
      value += (byte & 127) * factor;
      if (byte < 128) return value;
    }
    throw new Error("model.onnx is truncated; run prepare.py again.");
  };
  while (offset < bytes.length) {
    const tag = readVarint();
    const skip = { 0: () => void readVarint(), 1: () => (offset += 8), 5: () => (offset += 4) }[tag & 7];
    if (skip) {
      skip();
      continue;
    }
    const length = readVarint();
    if ((tag & 7) !== 2 || offset + length > bytes.length)
      throw new Error("model.onnx is not an ONNX file; run prepare.py again.");
    yield [tag >>> 3, bytes.subarray(offset, offset + length)];
    offset += length;
  }
}
