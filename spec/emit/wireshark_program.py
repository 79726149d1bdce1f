"""The program of the Wireshark dissector, in Lua: the same for every grammar.

It takes all that it knows of the protocol from the table `GRAMMAR`, which is written before it. It
runs in Lua 5.1 to 5.4: numbers are split by arithmetic, and written by string.format, since 5.4
shows 3.0 where the older ones show 3.
"""

PROGRAM = r"""
local robot = Proto(GRAMMAR.word, GRAMMAR.title)
local US, MS = 1000, 1000000 -- ns

robot.prefs.take = Pref.bool("Take every RTAC serial packet", true,
    "Off: they are shown as without this script")
robot.prefs.truncation_timeout = Pref.uint("Truncation time-out in us",
    GRAMMAR.truncation_timeout, "A longer pause inside a frame ends it")
robot.prefs.skew = Pref.uint("Skew of the taps in us", GRAMMAR.skew,
    "So long before its instruction a response may be stamped")

-- The names of all fields, as display filters have them, begin with GRAMMAR.word.
local fields = {}

local function declared(kind, word, ...)
    local made = ProtoField[kind](GRAMMAR.word .. "." .. word, ...)
    fields[#fields + 1] = made
    return made
end

local header_fields = {}
for _, part in ipairs(GRAMMAR.header) do
    header_fields[#header_fields + 1] = declared("uint8", part.word, part.word, base.DEC,
        part.names, part.mask, part.prose)
end

local function wireshark_type(part)
    local bits = part.size <= 4 and 8 * part.size or 64
    return string.format("%s%d", part.signed and "int" or "uint", bits)
end

for _, spec in pairs(GRAMMAR.instructions) do
    for _, part in ipairs(spec.fields) do
        part.field = declared(wireshark_type(part), part.word, part.name, base.DEC, nil, nil,
            part.prose)
        for _, bit in ipairs(part.bits) do
            bit.field = declared("bool", part.word .. "." .. bit.word, bit.name, 8 * part.size,
                { "on", "off" }, bit.mask)
        end
    end
end

local F = {
    data = declared("bytes", "data", "Data"),
    name = declared("string", "name", "Name"),
    kind = declared("string", "kind", "Kind"),
    outcome = declared("string", "outcome", "Outcome"),
    judgement = declared("uint8", "judgement", "A conforming device says", base.DEC,
        GRAMMAR.codes),
    reason = declared("string", "reason", "Reason"),
    sequence = declared("uint32", "sequence", "Number of the instruction"),
    response = declared("uint8", "response", "Response", base.DEC, GRAMMAR.codes),
    agrees = declared("bool", "agrees", "Is the expected response"),
    response_in = declared("framenum", "response_in", "Response in", base.NONE,
        frametype.RESPONSE),
    response_to = declared("framenum", "response_to", "Response to", base.NONE, frametype.REQUEST),
    latency = declared("relative_time", "latency", "Latency",
        "Time from the instruction's last byte to its response"),
    goes_on_in = declared("framenum", "goes_on_in", "Goes on in"),
    begins_in = declared("framenum", "begins_in", "Begins in"),
    cut_short = declared("framenum", "cut_short", "Cut short is the frame in"),
}
local state_fields = {}
for _, variable in ipairs(GRAMMAR.variables) do
    local kind = type(GRAMMAR.power_on[variable]) == "string" and "string" or "int64"
    state_fields[variable] = declared(kind, "state." .. variable, variable)
end
local moving_field = declared("bool", "state.moving", "moving")
robot.fields = fields

local X = {
    faulty = ProtoExpert.new(GRAMMAR.word .. ".expert.faulty", "Faulty instruction",
        expert.group.PROTOCOL, expert.severity.WARN),
    truncated = ProtoExpert.new(GRAMMAR.word .. ".expert.truncated", "Truncated instruction",
        expert.group.MALFORMED, expert.severity.WARN),
    garbage = ProtoExpert.new(GRAMMAR.word .. ".expert.garbage", "Bytes that belong to no frame",
        expert.group.UNDECODED, expert.severity.WARN),
    disagreeing = ProtoExpert.new(GRAMMAR.word .. ".expert.disagreeing",
        "Not the expected response", expert.group.RESPONSE_CODE, expert.severity.WARN),
    unused = ProtoExpert.new(GRAMMAR.word .. ".expert.unused", "Unused response",
        expert.group.RESPONSE_CODE, expert.severity.ERROR),
    late = ProtoExpert.new(GRAMMAR.word .. ".expert.late", "Late response",
        expert.group.SEQUENCE, expert.severity.WARN),
    unanswered = ProtoExpert.new(GRAMMAR.word .. ".expert.unanswered", "No response",
        expert.group.SEQUENCE, expert.severity.WARN),
    unsolicited = ProtoExpert.new(GRAMMAR.word .. ".expert.unsolicited",
        "Responds to no instruction", expert.group.SEQUENCE, expert.severity.WARN),
}
local experts = {}
for _, one in pairs(X) do
    experts[#experts + 1] = one
end
robot.experts = experts

-- Judging one frame: its header with as many data bytes as it announces, or fewer.

local function part_of(header, name)
    local part = GRAMMAR.header[name]
    return math.floor(header / part.unit) % part.size
end

local function hex(data)
    return (data:gsub(".", function(byte)
        return string.format("%02x ", byte:byte())
    end):gsub(" $", ""))
end

local function counted(count)
    return count == 1 and "1 data byte" or string.format("%d data bytes", count)
end

local function value_of(part, data)
    local value = 0
    for i = 1, part.size do
        local place = part.little and part.size + 1 - i or i
        value = value * 256 + data:byte(1 + part.offset + place)
    end
    if part.signed and value >= part.modulus / 2 then
        value = value - part.modulus
    end
    return value
end

local function judged(data)
    local header = data:byte(1)
    local id, length, came = part_of(header, "id"), part_of(header, "length"), #data - 1
    local spec = GRAMMAR.instructions[id]
    local verdict = { id = id, length = length, came = came, spec = spec, reason = "" }
    local outcome = "VALID"
    if not spec then
        outcome = "UNKNOWN_ID"
        verdict.reason = string.format("no instruction has ID %d, used are %s", id, GRAMMAR.used)
    elseif came < length then
        outcome = "TOO_FEW"
        verdict.reason = string.format("%s: %s announced, %d came", spec.name, counted(length),
            came)
    elseif length ~= spec.length then
        outcome = length > spec.length and "TOO_MANY" or "TOO_FEW"
        verdict.reason = string.format("%s takes %s, the header says %d", spec.name,
            counted(spec.length), length)
    else
        verdict.values = {}
        for i, part in ipairs(spec.fields) do
            local value = value_of(part, data)
            verdict.values[i] = value
            if outcome == "VALID" and (value < part.low or value > part.high) then
                outcome = "BAD_DATA"
                verdict.reason = string.format(
                    "%s.%s is %.0f, allowed are %.0f to %.0f (frame %s, byte %d)", spec.name,
                    part.name, value, part.low, part.high, hex(data), 1 + part.offset)
            end
        end
    end
    verdict.valid = outcome == "VALID"
    verdict.outcome = GRAMMAR.outcomes[outcome].words
    verdict.code = GRAMMAR.outcomes[outcome].code
    return verdict
end

local function bits_of(part, value)
    local set = {}
    for _, bit in ipairs(part.bits) do
        if math.floor(value / bit.mask) % 2 == 1 then
            set[#set + 1] = bit.name
        end
    end
    return #set > 0 and table.concat(set, " ") or "off"
end

local function name_of(verdict)
    return verdict.spec and verdict.spec.name or string.format("unused %d", verdict.id)
end

local function described(verdict)
    local words = { name_of(verdict) }
    if verdict.values then
        for i, part in ipairs(verdict.spec.fields) do
            local value = verdict.values[i]
            words[#words + 1] = string.format("%s=%.0f", part.name, value)
            if #part.bits > 0 and value <= part.high then
                words[#words + 1] = "(" .. bits_of(part, value) .. ")"
            end
        end
        return table.concat(words, " ")
    end
    local size = counted(verdict.length)
    if verdict.came < verdict.length then
        size = string.format("%d of %s", verdict.came, size)
    end
    return words[1] .. ", " .. size
end

-- The first pass. Packets come in order: frames are put together, over packets too, and responses
-- are paired with them. What it finds stays in `shown`, by packet, for every later look.

local now -- everything that depends on the packets before
local shown -- packet number -> list of items, each with `draw`, a function

local function note(number, item)
    shown[number] = shown[number] or {}
    table.insert(shown[number], item)
end

local function after(verdict, state)
    local new = {}
    for variable, value in pairs(state) do
        new[variable] = value
    end
    local sets = verdict.valid and verdict.spec.sets or GRAMMAR.on_fault
    for variable, set in pairs(sets) do
        if type(set) == "table" then
            new[variable] = verdict.values[set.field] * set.factor
        else
            new[variable] = set
        end
    end
    return new
end

-- The response that came before the frame's end: one tap may be late, or the device's time-out is
-- the shorter one. A packet tells only when the last of its bytes came.
local function early_answer(frame)
    local begun = frame.begun
    if frame.parts == 1 then
        begun = begun - (#frame.data - 1) * robot.prefs.truncation_timeout * US
    end
    local early
    repeat
        early = table.remove(now.early, 1)
    until not early or early.t + robot.prefs.skew * US > begun
    return early
end

local function ended(frame, kind)
    frame.kind, now.open = kind, nil
    if kind == "garbage" then
        return
    end
    local verdict = judged(frame.data)
    frame.verdict, frame.sequence = verdict, now.sequence
    now.sequence = now.sequence + 1
    now.state = after(verdict, now.state)
    frame.state = now.state
    frame.expires = frame.t + GRAMMAR.answer_longest * MS
    if verdict.came < verdict.length then
        frame.expires = frame.expires + GRAMMAR.truncation_longest * MS
    end
    if now.first < now.last then -- responses come in order: none is given up before
        frame.expires = math.max(frame.expires, now.waiting[now.last - 1].expires)
    end
    local early = early_answer(frame)
    if early then
        early.frame, frame.answer = frame, early
    else
        now.waiting[now.last] = frame
        now.last = now.last + 1
    end
end

local function next_waiting()
    local frame = now.waiting[now.first]
    now.waiting[now.first] = nil
    now.first = now.first + 1
    return frame
end

local function cut_short(number)
    local frame = now.open
    ended(frame, "truncated")
    note(number, { kind = "cut short", frame = frame })
end

-- Let time pass until `t` (ns), which packet `number` tells.
local function pass(t, number)
    if now.open and t >= now.open.t + robot.prefs.truncation_timeout * US then
        cut_short(number)
    end
    while now.first < now.last and now.waiting[now.first].expires <= t do
        next_waiting().unanswered = true
    end
end

local function host(bytes, t, number)
    local at = 1
    now.host = true
    while at <= #bytes do
        local frame = now.open
        if not frame then
            frame = { data = "", first = number, begun = t, parts = 0,
                size = 1 + part_of(bytes:byte(at), "length") }
            now.open = frame
        end
        local stop = math.min(#bytes, at + frame.size - #frame.data - 1)
        note(number, { kind = "host", frame = frame, at = at - 1, size = stop - at + 1 })
        frame.data = frame.data .. bytes:sub(at, stop)
        frame.t, frame.last = t, number
        frame.parts = frame.parts + 1
        if #frame.data == frame.size then
            ended(frame, "instruction")
        end
        at = stop + 1
    end
end

local function device(bytes, t, number)
    for at = 1, #bytes do
        local answer = { byte = bytes:byte(at), t = t, number = number, known = now.host }
        note(number, { kind = "device", answer = answer, at = at - 1, size = 1 })
        local first, second = now.waiting[now.first], now.waiting[now.first + 1]
        if second and answer.byte ~= first.verdict.code and answer.byte == second.verdict.code
            and (first.verdict.came < first.verdict.length
                or t - first.t > GRAMMAR.answer_deadline * MS) then
            next_waiting().unanswered = true -- the first may have gone unanswered
        end
        if first then
            answer.frame = next_waiting()
            answer.frame.answer = answer
        else
            now.early[#now.early + 1] = answer
        end
    end
end

local function lost()
    if now.open then
        now.open.reason = "bytes were lost in mid-frame"
        ended(now.open, "garbage")
    end
    now.waiting, now.first, now.last, now.early = {}, 1, 1, {}
end

-- The serial event types of the link type.
local HOST, DEVICE, HOST_END, DEVICE_END, LOST, OVERFLOW = 1, 2, 3, 4, 5, 10

local function learn(event, bytes, t, number)
    pass(t, number)
    if event == HOST then
        host(bytes, t, number)
    elseif event == DEVICE then
        device(bytes, t, number)
    elseif event == HOST_END then
        if now.open then
            cut_short(number)
        end
        if #bytes > 0 then
            local garbage = { kind = "garbage", data = bytes, first = number, last = number,
                reason = "they belong to no frame", parts = 1 }
            note(number, { kind = "host", frame = garbage, at = 0, size = #bytes })
        end
    elseif event == DEVICE_END then
        for at = 1, #bytes do
            local answer = { byte = bytes:byte(at), t = t, number = number, known = true }
            note(number, { kind = "device", answer = answer, at = at - 1, size = 1 })
        end
    elseif event == LOST or event == OVERFLOW then
        lost()
    end
end

function robot.init()
    local state = {}
    for variable, value in pairs(GRAMMAR.power_on) do
        state[variable] = value
    end
    shown = {}
    now = { state = state, sequence = 0, waiting = {}, first = 1, last = 1, early = {},
        host = false }
end

-- Showing what was found. Each function draws one item and returns its words for the info column.

local function generated(tree, field, ...)
    return tree:add(field, ...):set_generated()
end

local function draw_state(tree, state)
    local moving = state.speed > 0 and GRAMMAR.drives[state.motion] or false
    local words = {}
    local branch = tree:add("State after it"):set_generated()
    for _, variable in ipairs(GRAMMAR.variables) do
        local value = state[variable]
        if type(value) == "string" then
            words[#words + 1] = value
            generated(branch, state_fields[variable], value)
        else
            words[#words + 1] = string.format("%s %.0f", variable, value)
            generated(branch, state_fields[variable], Int64.new(value))
        end
    end
    generated(branch, moving_field, moving)
    branch:append_text(": " .. table.concat(words, ", ") .. (moving and ", moving" or ""))
end

local function draw_value(tree, part, range, value)
    local add = part.little and tree.add_le or tree.add
    local item = add(tree, part.field, range)
    if #part.bits > 0 then
        if value <= part.high then
            item:append_text(" (" .. bits_of(part, value) .. ")")
        end
        for _, bit in ipairs(part.bits) do
            add(item, bit.field, range)
        end
    end
end

local function draw_frame(tree, frame, range)
    local verdict = frame.verdict
    local words = described(verdict)
    local item = tree:add(robot, range, GRAMMAR.title .. ": " .. words)
    for _, field in ipairs(header_fields) do
        item:add(field, range(0, 1))
    end
    generated(item, F.name, name_of(verdict))
    if verdict.values then
        for i, part in ipairs(verdict.spec.fields) do
            draw_value(item, part, range(1 + part.offset, part.size), verdict.values[i])
        end
    elseif verdict.came > 0 then
        item:add(F.data, range(1, verdict.came))
    end
    generated(item, F.kind, frame.kind)
    generated(item, F.outcome, verdict.outcome)
    generated(item, F.judgement, verdict.code)
    if not verdict.valid then
        generated(item, F.reason, verdict.reason)
        item:add_proto_expert_info(frame.kind == "truncated" and X.truncated or X.faulty,
            verdict.reason)
        words = words .. ": " .. GRAMMAR.codes[verdict.code] .. ", " .. verdict.reason
    end
    generated(item, F.sequence, frame.sequence)
    if frame.first ~= frame.last then
        generated(item, F.begins_in, frame.first)
    end
    if frame.answer then
        generated(item, F.response_in, frame.answer.number)
    elseif frame.unanswered then
        item:add_proto_expert_info(X.unanswered, "No response")
    end
    draw_state(item, frame.state)
    return words
end

local function draw_host(item, tree, range, number)
    local frame = item.frame
    if frame.kind == "garbage" and frame.last == number then
        local branch = tree:add(robot, range, GRAMMAR.title .. ": garbage")
        branch:add(F.data, range)
        generated(branch, F.kind, "garbage")
        generated(branch, F.reason, frame.reason)
        branch:add_proto_expert_info(X.garbage, "Garbage: " .. frame.reason)
        return "garbage: " .. frame.reason
    elseif frame.kind and frame.last == number then
        if frame.parts > 1 then
            range = ByteArray.new(frame.data, true):tvb("Frame")()
        end
        return draw_frame(tree, frame, range)
    end
    local words = string.format("%s of a frame of %d bytes",
        frame.first == number and "beginning" or "part", frame.size)
    local branch = tree:add(robot, range, GRAMMAR.title .. ": " .. words)
    branch:add(F.data, range)
    if frame.last ~= number then
        generated(branch, F.goes_on_in, frame.last)
    end
    return words
end

local function draw_cut_short(item, tree)
    local words = "cut short: " .. described(item.frame.verdict)
    local branch = tree:add(robot, words)
    generated(branch, F.cut_short, item.frame.last)
    return words
end

local function time_of(ns)
    local sign = ns < 0 and -1 or 1
    local seconds = math.floor(sign * ns / 1e9)
    return NSTime.new(sign * seconds, sign * math.floor(sign * ns - seconds * 1e9))
end

local function draw_device(item, tree, range)
    local answer = item.answer
    local frame, name = answer.frame, GRAMMAR.codes[answer.byte]
    local words = name or string.format("unused %d", answer.byte)
    local branch = tree:add(robot, range, GRAMMAR.title .. ": " .. words)
    branch:add(F.response, range)
    generated(branch, F.kind, "response")
    local said = words
    if not name then
        branch:add_proto_expert_info(X.unused, "Unused response")
    end
    if not frame then
        if answer.known then
            branch:add_proto_expert_info(X.unsolicited, "It responds to no instruction")
        end
        return words
    end
    local agrees, latency = answer.byte == frame.verdict.code, answer.t - frame.t
    words = words .. " to " .. described(frame.verdict)
    generated(branch, F.response_to, frame.last)
    generated(branch, F.latency, time_of(latency))
    generated(branch, F.agrees, agrees)
    if not agrees then
        local expected = GRAMMAR.codes[frame.verdict.code]
        words = words .. ", expected is " .. expected
        generated(branch, F.judgement, frame.verdict.code)
        branch:add_proto_expert_info(X.disagreeing, string.format(
            "The device says %s to %s, expected is %s", said, described(frame.verdict), expected))
    end
    if latency > GRAMMAR.answer_deadline * MS then
        branch:add_proto_expert_info(X.late, string.format("After %.1f ms, allowed are %g",
            latency / MS, GRAMMAR.answer_deadline))
    end
    return words
end

local draw = { host = draw_host, device = draw_device, ["cut short"] = draw_cut_short }
local MOST_WORDS = 8 -- items that the info column names

-- The packet: 12 bytes of the link type (time, event, modem lines), then the bytes of the line.

local HEADER = 12
local link_types = DissectorTable.get("wtap_encap")
local RTAC_SERIAL = (wtap_encaps or wtap).RTAC_SERIAL
local rtac_serial = link_types:get_dissector(RTAC_SERIAL)

function robot.dissector(buffer, pinfo, tree)
    if not robot.prefs.take or buffer:len() < HEADER then
        return rtac_serial:call(buffer, pinfo, tree)
    end
    rtac_serial:call(buffer(0, HEADER):tvb(), pinfo, tree)
    local payload = buffer:len() > HEADER and buffer(HEADER) or nil
    if not pinfo.visited then
        local t = math.floor(pinfo.rel_ts * 1e9 + 0.5) -- exact to the ns for weeks; abs_ts is not
        learn(buffer(8, 1):uint(), payload and payload:raw() or "", t, pinfo.number)
    elseif now.open then
        ended(now.open, "truncated") -- the file is over
    end
    local items = shown[pinfo.number]
    if not items then
        return buffer:len()
    end
    local words = {}
    for i, item in ipairs(items) do
        local range = item.size and payload(item.at, item.size) or nil
        local said = draw[item.kind](item, tree, range, pinfo.number)
        if i <= MOST_WORDS then
            words[i] = said
        end
    end
    if #items > MOST_WORDS then
        words[#words + 1] = string.format("and %d more", #items - MOST_WORDS)
    end
    pinfo.cols.protocol = GRAMMAR.title
    pinfo.cols.info = table.concat(words, "; ")
    local from_host = items[1].kind ~= "device"
    pinfo.cols.src = from_host and "host" or "device"
    pinfo.cols.dst = from_host and "device" or "host"
    return buffer:len()
end

link_types:set(RTAC_SERIAL, robot)
"""
