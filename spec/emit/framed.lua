local protocol, format = Proto(GRAMMAR.word, GRAMMAR.title), string.format
local US, MS = 1000, 1000000 -- ns
local WIDEST = 6 -- bytes of a number: those of Lua are exact up to 2^53
protocol.prefs.take = Pref.bool("Take every RTAC serial packet", true,
    "Off: they are shown as without this script")

-- What a frame may have besides its bytes, in the order in which it is shown.
local GENERATED = {
    { word = "name", kind = "STRING", name = "Name" },
    { word = "kind", kind = "STRING", name = "Kind" },
    { word = "outcome", kind = "STRING", name = "Outcome" },
    { word = "check_good", kind = "BOOLEAN", name = "The check is right" },
    { word = "response_to", kind = "FRAMENUM", name = "Response to", names = frametype.REQUEST },
    { word = "latency", kind = "RELATIVE_TIME", name = "Latency",
        prose = "Time from the request's last byte to its response" },
    { word = "reason", kind = "STRING", name = "Reason" },
    { word = "response_in", kind = "FRAMENUM", name = "Response in", names = frametype.RESPONSE },
}
local DATA = { word = "data", kind = "BYTES", name = "Data" }

-- Declaring the fields. Those of one word hold the same kind of value.

local fields, kind_of = {}, {}

local function declare(row, word, kind)
    local class = kind:match("INT") or kind
    while kind_of[word] and kind_of[word] ~= class do word = word .. "_" end
    kind_of[word] = class
    local shape = kind:find("INT") and base.DEC or base.NONE
    if row.role == "check" and class == "INT" then shape = base.HEX end
    row.field = ProtoField.new(row.name ~= "" and row.name or "constant",
        GRAMMAR.word .. "." .. word, ftypes[kind], row.names or nil, shape, row.mask, row.prose)
    fields[#fields + 1] = row.field
end

local function declare_value(row, word)
    local size = row.count and row.width or row.size
    row.raw = string.char((table.unpack or unpack)(row.constant))
    row.bytes = #row.raw > 0 or not row.order or size > WIDEST
    if row.bytes then return declare(row, word, "BYTES") end
    declare(row, word, (row.signed and "INT" or "UINT") .. (size <= 4 and 8 * size or 64))
end

local LAYOUTS = { GRAMMAR.frame, GRAMMAR.reply, GRAMMAR.ack }
for _, layout in ipairs(GRAMMAR.errors) do table.insert(LAYOUTS, layout) end
for _, layout in ipairs(LAYOUTS) do
    for _, part in ipairs(layout.parts) do
        if part.width > 0 then part.mask = (2 ^ part.width - 1) * 2 ^ part.shift end
        if part.role == "code" and not GRAMMAR.flags then part.names = GRAMMAR.codes end
        if part.role == "id" and part.same == "" then part.names = GRAMMAR.ids end
        declare_value(part, part.word)
    end
end
for _, spec in pairs(GRAMMAR.instructions) do
    for _, row in ipairs(spec.fields) do declare_value(row, spec.word .. "." .. row.word) end
    for _, row in ipairs(spec.answer or {}) do
        declare_value(row, spec.word .. ".answer." .. row.word)
    end
end
for _, row in ipairs(GENERATED) do declare(row, row.word, row.kind) end
declare(DATA, DATA.word, DATA.kind)
protocol.fields = fields

local X = {}
for word, row in pairs({
    faulty = { "Faulty request", "PROTOCOL", "WARN" },
    damaged = { "Damaged response", "MALFORMED", "WARN" },
    garbage = { "Bytes that belong to no frame", "UNDECODED", "WARN" },
    late = { "Late response", "SEQUENCE", "WARN" },
    unsolicited = { "Responds to no request", "SEQUENCE", "WARN" },
}) do
    X[word] = ProtoExpert.new(GRAMMAR.word .. ".expert." .. word, row[1], expert.group[row[2]],
        expert.severity[row[3]])
end
protocol.experts = X

-- Checks, by arithmetic: not every Lua has signs for bits.

local function bxor(a, b)
    local value, bit = 0, 1
    while a > 0 or b > 0 do
        local x, y = a % 2, b % 2
        if x ~= y then value = value + bit end
        a, b, bit = (a - x) / 2, (b - y) / 2, bit * 2
    end
    return value
end

local function mirrored(value, width)
    local turned = 0
    for _ = 1, width do
        turned, value = turned * 2 + value % 2, math.floor(value / 2)
    end
    return turned
end

local function crc_table(check) -- what each value of the byte that leaves the register adds to it
    local made, top = {}, 2 ^ (check.width - 1)
    local poly = check.reflected and mirrored(check.poly, check.width) or check.poly
    for byte = 0, 255 do
        local value = check.reflected and byte or byte * 2 ^ (check.width - 8)
        for _ = 1, 8 do
            local out = check.reflected and value % 2 == 1 or not check.reflected and value >= top
            value = check.reflected and math.floor(value / 2) or value * 2 % (top * 2)
            if out then value = bxor(value, poly) end
        end
        made[byte] = value
    end
    return made
end

local FUNCTIONS = {
    Sum = function(check, bytes)
        local total, whole = 0, 2 ^ check.bits
        local complement = check.complement == true and 1 or check.complement or 0
        for i = 1, #bytes do total = total + bytes:byte(i) end
        if complement > 0 then total = complement - 2 - total end
        return total % whole
    end,
    Xor = function(check, bytes)
        local value = check.start
        for i = 1, #bytes do value = bxor(value, bytes:byte(i)) end
        return value
    end,
    Crc = function(check, bytes)
        check.table = check.table or crc_table(check)
        local value = check.reflected and mirrored(check.init, check.width) or check.init
        local over = 2 ^ (check.width - 8)
        for i = 1, #bytes do
            if check.reflected then
                value = bxor(math.floor(value / 256), check.table[bxor(value % 256, bytes:byte(i))])
            else
                local leaves = bxor(math.floor(value / over), bytes:byte(i))
                value = bxor(value % over * 256, check.table[leaves])
            end
        end
        return bxor(value, check.xorout)
    end,
}

local function covered(layout, bytes)
    local check = layout.check
    return check and bytes:sub(1 + check.first, #bytes - check.last) or bytes
end

-- Reading what stands in a frame.

local function hex(bytes)
    return (bytes:gsub(".", function(char) return format(" %02x", char:byte()) end):sub(2))
end

local function number_at(row, size, bytes, at)
    local value = 0
    for i = 1, size do
        value = value * 256 + bytes:byte(at + (row.order == "little" and size + 1 - i or i))
    end
    return row.signed and value >= 256 ^ size / 2 and value - 256 ^ size or value
end

local function place_of(part, bytes)
    return part.offset < 0 and #bytes + part.offset or part.offset
end

local function raw_of(part, bytes)
    local at = place_of(part, bytes)
    return bytes:sub(at + 1, at + part.size)
end

local function read(part, bytes)
    local value = number_at(part, part.size, bytes, place_of(part, bytes))
    if part.width > 0 then value = math.floor(value / 2 ^ part.shift) % 2 ^ part.width end
    return value - part.also
end

local function part_of(layout, role)
    for _, part in ipairs(layout.parts) do
        if part.role == role then return part end
    end
end

local function value_of(layout, role, bytes)
    local part = part_of(layout, role)
    return part and read(part, bytes)
end

local function wrong_constant(layout, bytes)
    for _, part in ipairs(layout.parts) do
        local found = raw_of(part, bytes)
        if part.role == "constant" and found ~= part.raw then
            return format("%s stands where %s must be", hex(found), hex(part.raw))
        end
    end
end

local function wrong_check(layout, bytes, before) -- and whether there is one
    local check = layout.check
    if not check then return nil, nil end
    local counted = (check.asked and before or "") .. covered(layout, bytes)
    local right, part = FUNCTIONS[check.kind](check, counted), part_of(layout, "check")
    if read(part, bytes) == right then return nil, true end
    local due = {}
    for i = 1, part.size do
        local place = part.order == "little" and i or part.size + 1 - i
        due[place], right = format("%02x", right % 256), math.floor(right / 256)
    end
    return format("%s is %s, right is %s", part.name, hex(raw_of(part, bytes)),
        table.concat(due, " ")), false
end

local function data_bytes(count)
    return format(count == 1 and "%d data byte" or "%d data bytes", count)
end

-- How many bytes data have that begin so; all where only the frame or a number before counts them.
local function measured(rows, data)
    local last = rows[#rows]
    if not last then return 0 end
    if last.count == "bytes in front" or last.count == "elements in front" then
        if #data < last.offset + last.prefix then return last.offset + last.prefix end
        local count = number_at({ order = last.prefix_order }, last.prefix, data, last.offset)
        local each = last.count == "bytes in front" and 1 or last.width
        return last.offset + last.prefix + count * each
    end
    if last.count and last.count ~= "fixed" then return math.max(#data, last.offset) end
    return last.offset + last.size
end

local function out_of_range(rows, data)
    for _, row in ipairs(rows) do
        if #row.raw > 0 and data:sub(row.offset + 1, row.offset + row.size) ~= row.raw then
            return format("%s is not as it must be", row.name)
        elseif not row.bytes and not row.count then
            local value = number_at(row, row.size, data, row.offset)
            local strange = row.names and not row.names[value]
            if row.mask_of_flags > 0 then -- others than these
                strange = bxor(value, row.mask_of_flags) ~= row.mask_of_flags - value
            end
            if strange or value < row.low or value > row.high then
                return format("%s is %.0f, which is out of its range", row.name, value)
            end
        end
    end
end

-- What a frame is, in words: who is meant, its name, its values.
local function words_of(item)
    local layout, bytes, words = item.layout, item.bytes, { item.name }
    local address = #bytes >= layout.head and value_of(layout, "address", bytes)
    if address then table.insert(words, 1, format("@%.0f", address)) end
    for _, row in ipairs(item.rows or {}) do
        local at, stop = layout.head + row.offset + row.prefix, #bytes - layout.tail
        if row.count == "fixed" or not row.count then stop = layout.head + row.offset + row.size end
        local each, values = row.bytes and stop - at or row.count and row.width or row.size, {}
        while each > 0 and at + each <= stop do
            table.insert(values, row.bytes and hex(bytes:sub(at + 1, at + each))
                or format("%.0f", number_at(row, each, bytes, at)))
            at = at + each
        end
        local value = table.concat(values, " ")
        local known = row.names and row.names[tonumber(value)]
        if known then value = format("%s (%s)", value, known) end
        if #row.raw == 0 then table.insert(words, row.name .. "=" .. value) end
    end
    return table.concat(words, " ") .. (item.reason and ": " .. item.reason or "")
end

-- Requests. A packet holds one frame, as in an exported file.

local function fault(item, bytes)
    local layout = GRAMMAR.frame
    local size = layout.head + layout.tail
    if #bytes >= size and item.spec then
        local data = bytes:sub(layout.head + 1, #bytes - layout.tail)
        local length = value_of(layout, "length", bytes)
        size = size + (length or measured(item.spec.fields, data))
    end
    if #bytes < size then
        item.cut = true
        return "TOO_FEW", format("%s: %d bytes came", item.name, #bytes)
    end
    local wrong = wrong_constant(layout, bytes)
    if wrong then return "BAD_SYNC", wrong end
    wrong, item.check_good = wrong_check(layout, bytes)
    if wrong then return "BAD_CHECKSUM", wrong end
    local to, id = part_of(layout, "address"), value_of(layout, "id", bytes)
    local address = to and read(to, bytes)
    item.all = to and address == to.broadcast
    if to and not item.all and (address < to.low or address > to.high) then
        return "OTHER_ADDRESS", format("%s is %.0f: it is for no device", to.name, address)
    end
    if not item.spec then
        return "UNKNOWN_ID", format("no instruction has ID %.0f, used are %s", id, GRAMMAR.used)
    end
    local data = bytes:sub(layout.head + 1, #bytes - layout.tail)
    local due = measured(item.spec.fields, data)
    if #data ~= due then
        return #data < due and "TOO_FEW" or "TOO_MANY",
            format("%s takes %s, %d came", item.spec.name, data_bytes(due), #data)
    end
    wrong = out_of_range(item.spec.fields, data)
    if wrong then return "BAD_DATA", item.spec.name .. "." .. wrong end
    return "VALID"
end

local function judge(bytes)
    local layout = GRAMMAR.frame
    local item = { bytes = bytes, kind = "instruction", layout = layout, name = "incomplete frame" }
    if #bytes >= layout.head then
        local id = value_of(layout, "id", bytes) or 0
        item.spec = GRAMMAR.instructions[id]
        item.name = item.spec and item.spec.name or format("unused %.0f", id)
    end
    local outcome, reason = fault(item, bytes)
    item.outcome, item.reason = GRAMMAR.outcomes[outcome][1], reason
    if outcome == "VALID" or outcome == "BAD_DATA" then item.rows = item.spec.fields end
    item.words = words_of(item)
    if reason then table.insert(item, { X.faulty, reason }) end
    item.silent = item.cut and layout.check or item.all or not GRAMMAR.outcomes[outcome][2]
        or outcome == "VALID" and not item.spec.answer
    return item
end

-- Responses: laid out as the request asks, or as an error is.

local function names_of(code)
    if not code then return "answer", true end
    if not GRAMMAR.flags or code == 0 then
        return GRAMMAR.codes[code] or format("unused %.0f", code), GRAMMAR.codes[code]
    end
    local names, known = {}, true
    for place = 0, 31 do
        if math.floor(code / 2 ^ place) % 2 == 1 then
            known = known and GRAMMAR.codes[2 ^ place]
            table.insert(names, GRAMMAR.codes[2 ^ place])
        end
    end
    return table.concat(names, " "), known
end

-- What keeps bytes from being an answer laid out so, and whether they are laid out so at all.
local function unlike(item, layout, rows, bytes, asked)
    if #bytes < layout.head + layout.tail then return "the bytes are not an answer" end
    for _, part in ipairs(layout.parts) do
        local most = part.width > 0 and 2 ^ part.width or 256 ^ part.size
        local own = asked and asked.parts[part.same]
        if own and read(part, bytes) ~= (own + part.plus) % most then
            return format("%s is %.0f, right is %.0f", part.name, read(part, bytes),
                (own + part.plus) % most)
        end
    end
    local data = bytes:sub(layout.head + 1, #bytes - layout.tail)
    local length = value_of(layout, "length", bytes)
    if length and length ~= #data or not layout.has_data and not length and #data > 0 then
        return "the bytes are not an answer"
    end
    local wrong = wrong_constant(layout, bytes)
    if wrong then return wrong end
    local name, known = names_of(value_of(layout, "code", bytes))
    if not known then return "it has an unused code", true end
    wrong, item.check_good = wrong_check(layout, bytes, asked and asked.covered)
    if wrong and (asked or not layout.check.asked) then return wrong, true end
    local due = rows and measured(rows, data)
    if due and due ~= #data then
        return format("it has %s, %d are due", data_bytes(#data), due), true
    end
    item.name, item.rows, item.layout = name, rows or {}, layout
end

local function answer(bytes, asked)
    local item = { bytes = bytes, kind = "response", layout = GRAMMAR.reply, name = "answer" }
    local spec = asked and asked.spec
    local rows = spec and spec.answer
    local usual = (not asked or rows and #rows > 0) and GRAMMAR.reply or GRAMMAR.ack
    local reason, near = unlike(item, usual, rows or asked and {}, bytes, asked)
    if near then item.layout = usual end
    for _, layout in ipairs(reason and GRAMMAR.errors or {}) do
        local error, nearer = unlike(item, layout, {}, bytes, asked)
        if not error then reason = nil break end
        if nearer and not near then item.layout, reason, near = layout, error, true end
    end
    item.reason = reason
    item.words = words_of(item)
    if reason then table.insert(item, { X.damaged, reason }) end
    return item
end

-- The first pass: packets come in order, and responses are paired with the requests that wait.

local now -- what depends on the packets before
local shown -- packet number -> item

local function ask(item)
    local layout = GRAMMAR.frame
    item.parts, item.covered = {}, covered(layout, item.bytes)
    for _, part in ipairs(#item.bytes >= layout.head + layout.tail and layout.parts or {}) do
        item.parts[part.name] = part.size <= WIDEST and read(part, item.bytes) or nil
    end
    if not item.silent then table.insert(now.waiting, item) end
end

-- The first request to which the bytes are a right answer. Where they are that to several it is the
-- first after the last pause: a host that pauses without an answer and asks again has given up.
local function respond(bytes)
    local right, place, before, paused
    for i, asked in ipairs(now.waiting) do
        paused = paused or before and asked.t - before >= GRAMMAR.gives_up * US
        before = asked.t
        if not right or paused then
            local item = answer(bytes, asked)
            if not item.reason then right, place, paused = item, i, false end
        end
    end
    local asked = now.waiting[place or 1]
    local item = right or answer(bytes, asked)
    if not asked then
        table.insert(item, { X.unsolicited, "It responds to no request" })
        return item
    end
    for _ = 1, place or 1 do table.remove(now.waiting, 1) end
    local latency = now.t - asked.t
    local rest = math.fmod(latency, 1e9)
    asked.response_in, item.response_to = now.number, asked.number
    item.latency = NSTime.new((latency - rest) / 1e9, rest)
    item.words = item.words .. " to " .. asked.name
    if latency > GRAMMAR.answer_deadline * MS then
        table.insert(item, { X.late, format("After %.1f ms, allowed are %g", latency / MS,
            GRAMMAR.answer_deadline) })
    end
    return item
end

local function learn(event, bytes)
    local item
    while now.waiting[1] and now.waiting[1].t + GRAMMAR.answer_longest * MS <= now.t do
        table.remove(now.waiting, 1)
    end
    if event == 1 and #bytes > 0 then
        item = judge(bytes)
        ask(item)
    elseif event == 2 and #bytes > 0 then
        item = respond(bytes)
    elseif event == 4 and #bytes > 0 then
        item = answer(bytes)
        table.insert(item, { X.unsolicited, "It responds to no request" })
    elseif event == 3 and #bytes > 0 then
        item = { bytes = bytes, kind = "garbage", words = "garbage" }
        table.insert(item, { X.garbage, "They belong to no frame" })
    elseif event == 5 or event == 10 then -- bytes were lost, by the capture or by the port
        now.waiting = {}
    end
    if item then item.number, item.t = now.number, now.t end
    return item
end

function protocol.init()
    shown, now = {}, { waiting = {} }
end

-- Showing what was found.

local function add(tree, row, range)
    local plain = row.bytes or row.order ~= "little"
    return (plain and tree.add or tree.add_le)(tree, row.field, range)
end

local function show_rows(tree, rows, range)
    for _, row in ipairs(rows) do
        local at = row.offset + row.prefix
        if row.count then
            local stop = row.count == "fixed" and row.offset + row.size or range:len()
            local each = row.bytes and stop - at or row.width
            while each > 0 and at + each <= stop do
                add(tree, row, range(at, each))
                at = at + each
            end
        else
            add(tree, row, range(at, row.size))
        end
    end
end

local function show(tree, item, payload)
    local bytes, layout = item.bytes, item.layout
    tree = tree:add(protocol, payload, GRAMMAR.title .. ": " .. item.words)
    if layout and #bytes >= layout.head + layout.tail then
        for _, part in ipairs(layout.parts) do
            add(tree, part, payload(place_of(part, bytes), part.size))
        end
        local size = #bytes - layout.head - layout.tail
        if size > 0 and item.rows and #item.rows > 0 then
            show_rows(tree, item.rows, payload(layout.head, size))
        elseif size > 0 then
            tree:add(DATA.field, payload(layout.head, size))
        end
    else
        tree:add(DATA.field, payload)
    end
    for _, row in ipairs(GENERATED) do
        local value = item[row.word]
        if value ~= nil then tree:add(row.field, value):set_generated() end
    end
    for _, row in ipairs(item) do tree:add_proto_expert_info(row[1], row[2]) end
end

-- The packet: 12 bytes of the link type (time, event, modem lines), then the bytes of the line.

local HEADER = 12
local link_types = DissectorTable.get("wtap_encap")
local RTAC_SERIAL = (wtap_encaps or wtap).RTAC_SERIAL
local rtac_serial = link_types:get_dissector(RTAC_SERIAL)

function protocol.dissector(buffer, pinfo, tree)
    if not protocol.prefs.take or buffer:len() < HEADER then
        return rtac_serial:call(buffer, pinfo, tree)
    end
    rtac_serial:call(buffer(0, HEADER):tvb(), pinfo, tree)
    local payload = buffer:len() > HEADER and buffer(HEADER)
    if not pinfo.visited then
        now.t = math.floor(pinfo.rel_ts * 1e9 + 0.5) -- exact to the ns for weeks; abs_ts is not
        now.number = pinfo.number
        shown[pinfo.number] = learn(buffer(8, 1):uint(), payload and payload:raw() or "")
    end
    local item = shown[pinfo.number]
    if item then
        show(tree, item, payload)
        local from, to = "host", "device"
        if item.kind == "response" then from, to = to, from end
        pinfo.cols.src, pinfo.cols.dst, pinfo.cols.protocol = from, to, GRAMMAR.title
        pinfo.cols.info = item.words
    end
    return buffer:len()
end

link_types:set(RTAC_SERIAL, protocol)
