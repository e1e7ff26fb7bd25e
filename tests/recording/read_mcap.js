// Reads an MCAP file with @mcap/core, once as a stream and once by its index, and prints what it found as JSON.
const { readFileSync } = require("node:fs");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { decompress } = require("fzstd");

const handlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };
const file = readFileSync(process.argv[2]);
const readable = {
  size: async () => BigInt(file.byteLength),
  read: async (offset, size) => new Uint8Array(file.subarray(Number(offset), Number(offset + size))),
};

const names = (channels, schemas) =>
  Object.fromEntries(
    [...channels.values()].map((channel) => [
      channel.topic,
      [schemas.get(channel.schemaId).name, schemas.get(channel.schemaId).encoding, channel.messageEncoding],
    ]),
  );
const text = (attachment) => [attachment.name, attachment.mediaType, Buffer.from(attachment.data).toString("base64")];
const counted = (counts, topic) => ({ ...counts, [topic]: (counts[topic] ?? 0) + 1 });

function stream() {
  const reader = new McapStreamReader({ decompressHandlers: handlers, validateCrcs: true });
  reader.append(file);
  const [channels, schemas, metadata, attachments] = [new Map(), new Map(), {}, []];
  let [counts, statistics] = [{}, null];
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === "Schema") schemas.set(record.id, record);
    if (record.type === "Channel") channels.set(record.id, record);
    if (record.type === "Message") counts = counted(counts, channels.get(record.channelId).topic);
    if (record.type === "Metadata") metadata[record.name] = Object.fromEntries(record.metadata);
    if (record.type === "Attachment") attachments.push(text(record));
    if (record.type === "Statistics") statistics = Number(record.messageCount);
  }
  return { channels: names(channels, schemas), counts, metadata, attachments, statistics, done: reader.done() };
}

async function indexed() {
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: handlers });
  const [metadata, attachments] = [{}, []];
  let counts = {};
  for await (const message of reader.readMessages({ validateCrcs: true }))
    counts = counted(counts, reader.channelsById.get(message.channelId).topic);
  for await (const record of reader.readMetadata()) metadata[record.name] = Object.fromEntries(record.metadata);
  for await (const attachment of reader.readAttachments()) attachments.push(text(attachment));
  const channels = names(reader.channelsById, reader.schemasById);
  return { channels, counts, metadata, attachments, statistics: Number(reader.statistics.messageCount), done: true };
}

indexed().then((found) => console.log(JSON.stringify({ stream: stream(), indexed: found })));
