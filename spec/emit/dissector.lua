local robot, format = Proto(GRAMMAR.word, GRAMMAR.title), string.format
local US, MS = 1000, 1000000 -- ns
robot.prefs.take = Pref.bool("Take every RTAC serial packet", true,
    "Off: they are shown as without this script")
robot.prefs.truncation_timeout = Pref.uint("Truncation time-out in us",
    GRAMMAR.truncation_timeout, "A longer pause inside a frame ends it")
robot.prefs.skew = Pref.uint("Skew of the taps in us", GRAMMAR.skew,
    "So long before its instruction a response may be stamped")

-- What an item may have besides its bytes, in the order in which it is shown.
local GENERATED = {
    { word = "name", kind = "STRING", name = "Name" },
    { word = "kind", kind = "STRING", name = "Kind" },
    { word = "outcome", kind = "STRING", name = "Outcome" },
    { word = "response_to", kind = "FRAMENUM", name = "Response to", names = frametype.REQUEST },
    { word = "latency", kind = "RELATIVE_TIME", name = "Latency",
        prose = "Time from the instruction's last byte to its response" },
    { word = "agrees", kind = "BOOLEAN", name = "Is the expected response" },
    { word = "judgement", kind = "UINT8", name = "A conforming device says",
        names = GRAMMAR.codes },
    { word = "reason", kind = "STRING", name = "Reason" },
    { word = "sequence", kind = "UINT32", name = "Number of the instruction" },
    { word = "begins_in", kind = "FRAMENUM", name = "Begins in" },
    { word = "goes_on_in", kind = "FRAMENUM", name = "Goes on in" },
    { word = "cut_short", kind = "FRAMENUM", name = "Cut short is the frame in" },
    { word = "response_in", kind = "FRAMENUM", name = "Response in", names = frametype.RESPONSE },
}
local OTHERS = {
    { word = "data", kind = "BYTES", name = "Data" },
    { word = "response", kind = "UINT8", name = "Response", names = GRAMMAR.codes },
    { word = "state.moving", kind = "BOOLEAN", name = "moving" },
}

local F, X, fields = {}, {}, {} -- fields and expert infos by their words, and all fields
local function declare(rows)
    for _, row in ipairs(rows) do
        local shape = row.width or row.kind:find("INT") and base.DEC or base.NONE
        row.field = ProtoField.new(row.name, GRAMMAR.word .. "." .. row.word, ftypes[row.kind],
            row.names, shape, row.mask, row.prose)
        F[row.word], fields[#fields + 1] = row, row.field
        declare(row.bits or {})
    end
end
for _, rows in ipairs({ GRAMMAR.header, GRAMMAR.state, GENERATED, OTHERS }) do declare(rows) end
for _, spec in pairs(GRAMMAR.instructions) do declare(spec.fields) end
robot.fields = fields

for word, row in pairs({
    faulty = { "Faulty instruction", "PROTOCOL", "WARN" },
    truncated = { "Truncated instruction", "MALFORMED", "WARN" },
    garbage = { "Bytes that belong to no frame", "UNDECODED", "WARN" },
    disagreeing = { "Not the expected response", "RESPONSE_CODE", "WARN" },
    unused = { "Unused response", "RESPONSE_CODE", "ERROR" },
    late = { "Late response", "SEQUENCE", "WARN" },
    unanswered = { "No response", "SEQUENCE", "WARN" },
    unsolicited = { "Responds to no instruction", "SEQUENCE", "WARN" },
}) do
    X[word] = ProtoExpert.new(GRAMMAR.word .. ".expert." .. word, row[1], expert.group[row[2]],
        expert.severity[row[3]])
end
robot.experts = X

-- Judging one frame: its header with as many data bytes as it announces, or fewer.

local function part_of(header, word)
    return math.floor(header / F[word].unit) % F[word].size
end

local function counted(count)
    return format(count == 1 and "%d data byte" or "%d data bytes", count)
end

local function value_of(part, data)
    local value = 0
    for i = 1, part.size do
        local place = part.little and part.size + 1 - i or i
        value = value * 256 + data:byte(1 + part.offset + place)
    end
    return part.signed and value >= 256 ^ part.size / 2 and value - 256 ^ part.size or value
end

local function bits_of(part, value)
    local set = {}
    if #part.bits == 0 or value > part.high then return "" end
    for _, bit in ipairs(part.bits) do
        if math.floor(value / bit.mask) % 2 == 1 then table.insert(set, bit.name) end
    end
    return format(" (%s)", #set > 0 and table.concat(set, " ") or "off")
end

local function judge(item, data)
    local id, length = part_of(data:byte(1), "id"), part_of(data:byte(1), "length")
    local came, size, spec = #data - 1, counted(length), GRAMMAR.instructions[id]
    local outcome, reason = "VALID"
    item.spec, item.cut, item.name = spec, came < length, spec and spec.name or "unused " .. id
    item.words = item.name .. ", " .. (item.cut and format("%d of %s", came, size) or size)
    if not spec then
        outcome = "UNKNOWN_ID"
        reason = format("no instruction has ID %d, used are %s", id, GRAMMAR.used)
    elseif item.cut then
        outcome, reason = "TOO_FEW", format("%s: %s announced, %d came", spec.name, size, came)
    elseif length ~= spec.length then
        outcome = length > spec.length and "TOO_MANY" or "TOO_FEW"
        reason = format("%s takes %s, the header says %d", spec.name, counted(spec.length), length)
    else
        item.words, item.values = spec.name, {}
        for i, part in ipairs(spec.fields) do
            local value = value_of(part, data)
            item.values[i] = value
            item.words = format("%s %s=%.0f%s", item.words, part.name, value, bits_of(part, value))
            if not reason and (value < part.low or value > part.high) then
                outcome, reason = "BAD_DATA", format(
                    "%s.%s is %.0f, allowed are %.0f to %.0f (frame %s, byte %d)", spec.name,
                    part.name, value, part.low, part.high,
                    ByteArray.new(data, true):tohex(true, " "), 1 + part.offset)
            end
        end
    end
    item.outcome, item.judgement = GRAMMAR.outcomes[outcome][1], GRAMMAR.outcomes[outcome][2]
    item.reason = reason
end

-- The first pass. Packets come in order: frames are put together, over packets too, and responses
-- are paired with them. What it finds stays in `shown`, by packet, for every later look.

local now -- what depends on the packets before; `first` to `last` wait for a response, in a chain
local shown -- packet number -> list of items; an item's own list are its expert infos

local function note(item)
    item.number, item.t = now.number, now.t
    table.insert(shown[now.number], item)
    return item
end

local function warn(item, word, words)
    table.insert(item, { X[word], words })
end

local function garbage(item, reason)
    item.kind, item.words = "garbage", "garbage"
    item.reason, item.info = reason, "garbage: " .. reason
    warn(item, "garbage", "Garbage: " .. reason)
end

local function unanswered()
    warn(now.first, "unanswered", "No response")
    now.first = now.first.next
end

local function pair(frame, answer)
    local latency, expected = answer.t - frame.t, GRAMMAR.codes[frame.judgement]
    local rest = math.fmod(latency, 1e9)
    frame.response_in, answer.response_to = answer.number, frame.number
    answer.latency = NSTime.new((latency - rest) / 1e9, rest)
    answer.agrees = answer.byte == frame.judgement
    answer.info = answer.words .. " to " .. frame.words
    if not answer.agrees then
        answer.judgement, answer.info = frame.judgement, answer.info .. ", expected is " .. expected
        warn(answer, "disagreeing", "The device says " .. answer.info)
    end
    if latency > GRAMMAR.answer_deadline * MS then
        warn(answer, "late", format("After %.1f ms, allowed are %g", latency / MS,
            GRAMMAR.answer_deadline))
    end
end

-- Pair the frame with a response that came before its end, or let it wait for one: a tap may be
-- late, or the device's time-out the shorter one. A packet tells only when its last byte came.
local function await(frame, begun)
    local early
    repeat
        early = table.remove(now.early, 1)
    until not early or early.t + robot.prefs.skew * US > begun
    if early then return pair(frame, early) end
    local longest = GRAMMAR.answer_longest + (frame.cut and GRAMMAR.truncation_longest or 0)
    frame.expires = frame.t + longest * MS
    if now.first then -- responses come in order: none is given up before
        frame.expires = math.max(frame.expires, now.last.expires)
        now.last.next = frame
    end
    now.first, now.last = now.first or frame, frame
end

local function new_value(old, set, values) -- false: not known
    if type(set) ~= "table" then return set end
    if set[1] > 0 then return values[set[1]] * set[2] end
    return old and math.min(math.max(old * set[2] + set[3], set[4]), set[5])
end

local function change_state(frame)
    frame.state = {}
    for variable, value in pairs(now.state) do frame.state[variable] = value end
    for variable, set in pairs(frame.reason and GRAMMAR.on_fault or frame.spec.sets) do
        frame.state[variable] = new_value(now.state[variable], set, frame.values)
    end
    now.state = frame.state
end

-- End the open frame, a list of its pieces; the last of them becomes the item for the whole.
local function ended(lost)
    local open = now.open
    local frame, single = open[#open], #open == 1
    now.open = nil
    for i = 1, #open - 1 do open[i].goes_on_in = frame.number end
    if lost then return garbage(frame, lost) end
    judge(frame, open.data)
    frame.kind = frame.cut and "truncated" or "instruction"
    frame.sequence, now.sequence = now.sequence, now.sequence + 1
    if frame.reason then
        local code = GRAMMAR.codes[frame.judgement]
        frame.info = format("%s: %s, %s", frame.words, code, frame.reason)
        warn(frame, frame.cut and "truncated" or "faulty", frame.reason)
    end
    if not single then frame.whole, frame.begins_in = open.data, open[1].number end
    change_state(frame)
    await(frame, open[1].t - (single and #open.data - 1 or 0) * robot.prefs.truncation_timeout * US)
    return frame
end

local function host(bytes)
    local at = 1
    now.heard = true
    while at <= #bytes do
        local open = now.open or { data = "", size = 1 + part_of(bytes:byte(at), "length") }
        local stop = math.min(#bytes, at + open.size - #open.data - 1)
        local place = #open == 0 and "beginning" or "part"
        table.insert(open, note({ at = at - 1, size = stop - at + 1,
            words = format("%s of a frame of %d bytes", place, open.size) }))
        open.data, now.open = open.data .. bytes:sub(at, stop), open
        if #open.data == open.size then ended() end
        at = stop + 1
    end
end

local function device(bytes, stray)
    for at = 1, #bytes do
        local byte, frame = bytes:byte(at), not stray and now.first
        local name, after = GRAMMAR.codes[byte], frame and frame.next
        local answer = note({ at = at - 1, size = 1, byte = byte, kind = "response",
            words = name or "unused " .. byte, known = stray or now.heard })
        if not name then warn(answer, "unused", "Unused response") end
        if after and byte ~= frame.judgement and byte == after.judgement
            and (frame.cut or now.t - frame.t > GRAMMAR.answer_deadline * MS) then
            unanswered() -- the first may have gone unanswered
        end
        if frame then
            pair(now.first, answer)
            now.first = now.first.next
        elseif not stray then
            table.insert(now.early, answer)
        end
    end
end

local function learn(event, bytes)
    local open, timeout = now.open, robot.prefs.truncation_timeout * US
    if open and (event == 3 or now.t >= open[#open].t + timeout) then
        local frame = ended()
        note({ words = "cut short: " .. frame.words, cut_short = frame.number })
    end
    while now.first and now.first.expires <= now.t do unanswered() end
    if event == 1 then
        host(bytes)
    elseif event == 2 or event == 4 then -- what stands at the end of data answers nothing
        device(bytes, event == 4)
    elseif event == 3 and #bytes > 0 then
        garbage(note({ at = 0, size = #bytes }), "they belong to no frame")
    elseif event == 5 or event == 10 then -- bytes were lost, by the capture or by the port
        if now.open then ended("bytes were lost in mid-frame") end
        now.first, now.early = nil, {}
    end
end

function robot.init()
    shown, now = {}, { state = GRAMMAR.power_on, sequence = 0, heard = false, early = {} }
end

-- Showing what was found.

local function at_rest(state)
    local all = GRAMMAR.at_rest.all
    for name, value in pairs(GRAMMAR.at_rest.values) do
        if (state[name] == value) ~= all then return not all end
    end
    return all
end

local function show_state(tree, state)
    local words, branch = {}, tree:add("State after it"):set_generated()
    for _, row in ipairs(GRAMMAR.state) do
        local value = state[row.name]
        local number = type(value) == "number"
        local word = value or row.name .. " not known"
        table.insert(words, number and format("%s %.0f", row.name, value) or word)
        if value then
            branch:add(row.field, number and Int64.new(value) or value):set_generated()
        end
    end
    local moving = GRAMMAR.at_rest and not at_rest(state)
    if GRAMMAR.at_rest then branch:add(F["state.moving"].field, moving):set_generated() end
    branch:append_text(": " .. table.concat(words, ", ") .. (moving and ", moving" or ""))
end

local function show_frame(tree, frame, range)
    for _, row in ipairs(GRAMMAR.header) do tree:add(row.field, range(0, 1)) end
    if not frame.values and range:len() > 1 then tree:add(F.data.field, range(1)) end
    for i, value in ipairs(frame.values or {}) do
        local part = frame.spec.fields[i]
        local add = part.little and tree.add_le or tree.add
        local bytes = range(1 + part.offset, part.size)
        local item = add(tree, part.field, bytes):append_text(bits_of(part, value))
        for _, bit in ipairs(part.bits) do add(item, bit.field, bytes) end
    end
end

local function show(tree, item, payload)
    local range = item.whole and ByteArray.new(item.whole, true):tvb("Frame")()
        or item.size and payload(item.at, item.size)
    tree = range and tree:add(robot, range, GRAMMAR.title .. ": " .. item.words)
        or tree:add(robot, item.words)
    if item.state then
        show_frame(tree, item, range)
    elseif range then
        tree:add((item.byte and F.response or F.data).field, range)
    end
    for _, row in ipairs(GENERATED) do
        local value = item[row.word]
        if value ~= nil then tree:add(row.field, value):set_generated() end
    end
    for _, row in ipairs(item) do tree:add_proto_expert_info(row[1], row[2]) end
    if item.known and not item.response_to then
        tree:add_proto_expert_info(X.unsolicited, "It responds to no instruction")
    end
    if item.state then show_state(tree, item.state) end
end

-- The packet: 12 bytes of the link type (time, event, modem lines), then the bytes of the line.

local HEADER, MOST_WORDS = 12, 8 -- of the items the info column names at most so many
local link_types = DissectorTable.get("wtap_encap")
local RTAC_SERIAL = (wtap_encaps or wtap).RTAC_SERIAL
local rtac_serial = link_types:get_dissector(RTAC_SERIAL)

function robot.dissector(buffer, pinfo, tree)
    if not robot.prefs.take or buffer:len() < HEADER then
        return rtac_serial:call(buffer, pinfo, tree)
    end
    rtac_serial:call(buffer(0, HEADER):tvb(), pinfo, tree)
    local payload = buffer:len() > HEADER and buffer(HEADER)
    if not pinfo.visited then
        now.t = math.floor(pinfo.rel_ts * 1e9 + 0.5) -- exact to the ns for weeks; abs_ts is not
        now.number, shown[pinfo.number] = pinfo.number, {}
        learn(buffer(8, 1):uint(), payload and payload:raw() or "")
    elseif now.open then
        ended() -- the file is over
    end
    local items, words = shown[pinfo.number] or {}, {}
    for i, item in ipairs(items) do
        show(tree, item, payload)
        words[i] = i <= MOST_WORDS and (item.info or item.words) or nil
    end
    if #items > MOST_WORDS then table.insert(words, format("and %d more", #items - MOST_WORDS)) end
    if #items > 0 then
        local from, to = "host", "device"
        if items[1].byte then from, to = to, from end
        pinfo.cols.src, pinfo.cols.dst, pinfo.cols.protocol = from, to, GRAMMAR.title
        pinfo.cols.info = table.concat(words, "; ")
    end
    return buffer:len()
end

link_types:set(RTAC_SERIAL, robot)
