// Reads a capture by the MCAP project's own JavaScript reader, which checks every CRC, by its index and
// as a stream, and prints what it holds as JSON: bytes or messages by topic, metadata, attachments.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";

const [packages, path] = process.argv.slice(2);
const require = createRequire(`${packages}/`);
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");

const data = new Uint8Array(await readFile(path));
const decompressHandlers = await loadDecompressHandlers();
const readable = {
  size: async () => BigInt(data.byteLength),
  read: async (offset, length) => data.slice(Number(offset), Number(offset + length)),
};
const raw = {}, messages = {}, metadata = [];

const indexed = await McapIndexedReader.Initialize({ readable, decompressHandlers });
for await (const message of indexed.readMessages()) {
  const channel = indexed.channelsById.get(message.channelId);
  if (channel.messageEncoding === "json") {
    JSON.parse(Buffer.from(message.data).toString());
    messages[channel.topic] = (messages[channel.topic] ?? 0) + 1;
  } else {
    raw[channel.topic] = (raw[channel.topic] ?? "") + Buffer.from(message.data).toString("hex");
  }
}
for await (const one of indexed.readMetadata()) metadata.push(one.name);

let streamed = 0;
const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
stream.append(data);
for (let record; (record = stream.nextRecord()); ) streamed += record.type === "Message";
if (!stream.done()) throw new Error("the stream does not end with the file");

console.log(JSON.stringify({ raw, messages, metadata, streamed }));
